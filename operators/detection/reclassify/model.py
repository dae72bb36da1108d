"""The reclassifier's network in use."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from operators.detection.reclassify.closeups import AROUND, SIDE, closeups
from operators.weights import open_kind

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
KIND = "reclassifier"


@dataclass(frozen=True, eq=False)
class ReclassifierModel:
    """An opened network. It runs on one CPU thread, so equal images give equal classes."""

    classes: tuple[str, ...]
    session: onnxruntime.InferenceSession

    @classmethod
    def open(cls, file: Path) -> ReclassifierModel:
        """Raises FileNotFoundError, or NetworkFileError where the file is no network for our close-ups."""
        session, facts = open_kind(file, KIND, ("classes",), {"side": SIDE, "around": AROUND})
        return cls(tuple(map(str, facts["classes"])), session)

    def judge(self, pixels: NDArray[np.uint8], boxes: F32) -> F32:
        """Returns probabilities (N, C) of what boxes (N, 4) of an image (H, W, 3), RGB, show."""
        (found,) = self.session.run(None, {"closeups": closeups(pixels, boxes)})
        return np.asarray(found, np.float32)
