"""Points that stay where they were seen: one in each cell of space that was seen often enough. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Points = npt.NDArray[np.float64]
Paint = npt.NDArray[np.uint8]

_WAITING = 16
"""Clouds that wait for the pose of their stamp."""

_BITS = 21  # of a coordinate of a cell


@dataclass(slots=True)
class KeptPoints:
    """The cells of a stream of clouds.

    `step`: their side, metres; `after`: clouds with a point in a cell from which it counts.
    """

    step: float
    after: int
    _counts: dict[int, int] = field(default_factory=dict)
    _waiting: deque[tuple[int, str, Points, Paint]] = field(default_factory=lambda: deque(maxlen=_WAITING))

    def add(
        self, stamp: int, frame: str, points: Points, paint: Paint, pose_at: Callable[[str, int], Points | None]
    ) -> Iterator[tuple[int, Points, Paint]]:
        """Takes a cloud in its sensor's frame; gives (stamp, points in the root frame, colours) of cells that are new.

        A cloud waits until the pose of its frame at its stamp is known: it may arrive later.
        """
        self._waiting.append((stamp, frame, points, paint))
        for _ in range(len(self._waiting)):
            entry = self._waiting.popleft()
            T = pose_at(entry[1], entry[0])
            if T is None:
                self._waiting.append(entry)
                continue
            placed = entry[2] @ T[:3, :3].T + T[:3, 3]
            new = self._new(placed)
            if len(new):
                yield entry[0], placed[new], entry[3][new]

    def _new(self, points: Points) -> npt.NDArray[np.int64]:
        """Indices of one point in each cell that has now been seen often enough."""
        cells = np.floor(points / self.step).astype(np.int64)
        limit = 1 << (_BITS - 1)
        inside = np.flatnonzero((np.abs(cells) < limit).all(axis=1))
        x, y, z = (cells[inside] + limit).T
        keys, first = np.unique((x << 2 * _BITS) | (y << _BITS) | z, return_index=True)
        counts, new = self._counts, []
        for key, index in zip(keys.tolist(), first.tolist(), strict=True):
            seen = counts.get(key, 0) + 1
            counts[key] = seen
            if seen == self.after:
                new.append(index)
        return inside[np.array(new, np.int64)]
