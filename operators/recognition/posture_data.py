"""Silhouettes with what is true of them: what the posture network is trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

POSTURES = ("standing", "walking", "sitting_down", "sitting", "standing_up", "reaching", "drinking")
"""Activities of persons that a single look tells something of."""
BODY = 18
"""Values that tell a posture: five joints (right, away, up), where the chest points (away, right), the lean."""


@dataclass(frozen=True, eq=False)
class Postures:
    """`silhouettes` (N, 3, S, S) in 127ths, `bodies` (N, BODY) metres and radians, `activities` (N,) of POSTURES."""

    silhouettes: NDArray[np.int8]
    bodies: NDArray[np.float32]
    activities: NDArray[np.int64]

    def write(self, file: Path) -> None:
        np.savez_compressed(file, silhouettes=self.silhouettes, bodies=self.bodies, activities=self.activities)

    @classmethod
    def read(cls, file: Path) -> Self:
        """Raises FileNotFoundError where there is no such file, ValueError for one that holds no silhouettes."""
        with np.load(file) as kept:
            lacking = {"silhouettes", "bodies", "activities"} - set(kept)
            if lacking:
                raise ValueError(f"{file} holds no {', '.join(sorted(lacking))}: delete it, and it is made anew")
            return cls(kept["silhouettes"], kept["bodies"], kept["activities"])

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns all parts one after the other."""
        return cls(
            np.concatenate([part.silhouettes for part in parts]),
            np.concatenate([part.bodies for part in parts]),
            np.concatenate([part.activities for part in parts]),
        )
