"""Episodes in a room, as boxes over time: the truth that activities and goals are learned from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Episode:
    """Objects (N) over time (T), of which some (A) act.

    `boxes` (T, N, 7) are centre, full size and heading, metres and radians; `camera` (T, 4, 4) the poses of the
    robot's optical frame in the world; `activities` (T, A) names; `goals` (T, A) ids, -1 for none.
    """

    name: str
    times: Array
    ids: NDArray[np.int64]
    labels: tuple[str, ...]
    boxes: NDArray[np.float32]
    camera: Array
    agents: NDArray[np.int64]
    activities: tuple[tuple[str, ...], ...]
    goals: NDArray[np.int64]

    def write(self, file: Path) -> None:
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in vars(self).items()}
        np.savez_compressed(file, **arrays)

    @classmethod
    def read(cls, file: Path) -> Episode:
        """Raises FileNotFoundError where there is no such file."""
        with np.load(file) as kept:
            return cls(
                name=str(kept["name"]),
                times=kept["times"],
                ids=kept["ids"],
                labels=tuple(kept["labels"].tolist()),
                boxes=kept["boxes"],
                camera=kept["camera"],
                agents=kept["agents"],
                activities=tuple(map(tuple, kept["activities"].tolist())),
                goals=kept["goals"],
            )
