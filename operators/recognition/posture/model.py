"""The posture network in use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from operators.recognition.posture.silhouette import HALF, MIDDLE, SIDE
from operators.weights import open_kind

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
KIND = "posture"


@dataclass(frozen=True, eq=False)
class PostureModel:
    """An opened network. It runs on one CPU thread, so equal inputs give equal outputs."""

    classes: tuple[str, ...]
    session: onnxruntime.InferenceSession

    @classmethod
    def open(cls, file: Path) -> PostureModel:
        """Raises FileNotFoundError, or NetworkFileError where the file is no posture network for our silhouettes."""
        session, facts = open_kind(file, KIND, ("classes",), {"side": SIDE, "half": HALF, "middle": MIDDLE})
        return cls(tuple(map(str, facts["classes"])), session)

    def judge(self, silhouettes: F32) -> F32:
        """Returns probabilities (N, C) for silhouettes (N, 3, SIDE, SIDE)."""
        (found,) = self.session.run(None, {"silhouettes": silhouettes})
        return np.asarray(found, np.float32)
