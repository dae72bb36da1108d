"""The activity network in use: one step for several agents, with the state of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from operators.recognition.activity.features import NAMES
from operators.weights import NetworkFileError, open_kind

if TYPE_CHECKING:
    import onnxruntime

F32 = NDArray[np.float32]
KIND = "activity"


@dataclass(frozen=True, eq=False)
class ActivityModel:
    """An opened network. It runs on one CPU thread, so equal inputs give equal outputs."""

    classes: tuple[str, ...]
    layers: int
    width: int
    session: onnxruntime.InferenceSession

    @classmethod
    def open(cls, file: Path) -> ActivityModel:
        """Raises FileNotFoundError, or NetworkFileError where the file is no activity network for our features."""
        session, facts = open_kind(file, KIND, ("classes", "layers", "width"))
        if tuple(facts.get("features", ())) != NAMES:
            raise NetworkFileError(
                f"{file} was trained on other features than these {len(NAMES)}: train one by `dataflow train {KIND}`"
            )
        return cls(tuple(map(str, facts["classes"])), int(facts["layers"]), int(facts["width"]), session)

    def fresh(self) -> F32:
        """Returns the state (2, L, W) of an agent that was never seen: hidden, then cell."""
        return np.zeros((2, self.layers, self.width), np.float32)

    def step(self, features: F32, states: F32) -> tuple[F32, F32]:
        """Returns probabilities (N, C) and next states (N, 2, L, W) for features (N, F) and states (N, 2, L, W)."""
        hidden, cell = (np.ascontiguousarray(states[:, k].transpose(1, 0, 2)) for k in (0, 1))
        found = self.session.run(None, {"features": features, "hidden": hidden, "cell": cell})
        probabilities, hidden, cell = (np.asarray(each, np.float32) for each in found)
        return probabilities, np.stack([hidden.transpose(1, 0, 2), cell.transpose(1, 0, 2)], axis=1)
