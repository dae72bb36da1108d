"""Silhouettes with what is true of them: what the posture network is trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

POSTURES = ("standing", "walking", "sitting_down", "sitting", "standing_up", "reaching", "drinking")
"""Activities of persons for which a single look is evidence."""
BODY = 18
"""Values that show a posture: five joints (right, away, up), where the chest points (away, right), the lean."""


@dataclass(frozen=True, eq=False)
class Postures:
    """`silhouettes` (N, 3, S, S) in 127ths, `bodies` (N, BODY) metres and radians, `activities` (N,) of POSTURES."""

    silhouettes: NDArray[np.int8]
    bodies: NDArray[np.float32]
    activities: NDArray[np.int64]

    def write(self, file: Path) -> None:
        """Writes all arrays to a compressed NumPy file."""
        np.savez_compressed(file, **{name: getattr(self, name) for name in self._names()})

    @classmethod
    def read(cls, file: Path) -> Self:
        """Raises FileNotFoundError where there is no such file, ValueError for one that lacks some of the arrays."""
        with np.load(file) as kept:
            lacking = set(cls._names()) - set(kept)
            if lacking:
                raise ValueError(f"{file} holds no {', '.join(sorted(lacking))}: delete it, and it is made anew")
            return cls(**{name: kept[name] for name in cls._names()})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns the rows of all parts, one part after the other."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in cls._names()})

    @classmethod
    def _names(cls) -> list[str]:
        return [field.name for field in fields(cls)]
