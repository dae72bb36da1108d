"""Where something that moves stood on the floor when a sensor last looked there: free or taken is both right then."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dataflow.messages import OccupancyGrid, SceneGraph

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOVED = 0.05
"""Metres within a drive that make a thing one that moves."""
ALIVE = {"person", "robot"}
"""These count though they stand still."""
BORDER = 0.05
"""Metres around their boxes that are theirs, too."""
STEP = 0.025
"""Metres between the samples of a ray."""


@dataclass
class Movers:
    """Boxes (position, size, orientation) of what moves, by stamp, from the true scene graphs of a whole drive."""

    scenes: dict[int, SceneGraph]
    moving: set[int] = field(init=False)

    def __post_init__(self) -> None:
        places: dict[int, list[Array]] = {}
        self.moving = set()
        for scene in self.scenes.values():
            for row, thing in enumerate(scene.ids.tolist()):
                places.setdefault(thing, []).append(scene.positions[row])
                if scene.class_names[scene.class_ids[row]] in ALIVE:
                    self.moving.add(thing)
        self.moving |= {thing for thing, seen in places.items() if np.ptp(seen, axis=0).max() > MOVED}

    def at(self, stamp: int) -> list[tuple[Array, Array, Array]]:
        scene = self.scenes[min(self.scenes, key=lambda other: abs(other - stamp))]
        rows = [row for row, thing in enumerate(scene.ids.tolist()) if thing in self.moving]
        turned = scene.orientations
        assert turned is not None
        return [(scene.positions[row], scene.sizes[row], turned[row]) for row in rows]


class LastSeen:
    """Cells of a grid where, when a ray last met them, something that moves stood."""

    def __init__(self, truth: OccupancyGrid, movers: Movers, band: tuple[float, float]) -> None:
        self.held: Mask = np.zeros(truth.cells.shape, np.bool_)
        self._truth, self._movers, self._band = truth, movers, band
        rows, columns = np.mgrid[: truth.cells.shape[0], : truth.cells.shape[1]]
        self._x = truth.position[0] + (columns + 0.5) * truth.resolution
        self._y = truth.position[1] + (rows + 0.5) * truth.resolution

    def add(self, stamp: int, origin: Array, points: NDArray[np.floating], far: float) -> None:
        """Takes what a sensor at `origin` (3,) saw, points (N, 3), and looks along its rays as far as `far`."""
        seen = self._met(origin, points, far)
        standing: Mask = np.zeros_like(self.held)
        for position, size, orientation in self._movers.at(stamp):
            if position[2] - size[2] / 2 > self._band[1]:
                continue
            ahead = Rotation.from_quat(orientation).as_matrix()[:2, 0]
            along, across = ahead / np.linalg.norm(ahead), np.array([-ahead[1], ahead[0]]) / np.linalg.norm(ahead)
            dx, dy = self._x - position[0], self._y - position[1]
            standing |= (np.abs(along[0] * dx + along[1] * dy) < size[0] / 2 + BORDER) & (
                np.abs(across[0] * dx + across[1] * dy) < size[1] / 2 + BORDER
            )
        self.held = np.where(seen, standing, self.held)

    def _met(self, origin: Array, points: NDArray[np.floating], far: float) -> Mask:
        off = points - origin
        distance = np.linalg.norm(off, axis=1)
        usable = (distance > 2 * STEP) & np.isfinite(distance)
        off, distance = off[usable] / distance[usable, None], np.minimum(distance[usable], far)
        met: Mask = np.zeros(self.held.shape, np.bool_)
        truth = self._truth
        for reach in np.arange(0.0, far, STEP):
            rays = off[distance >= reach]
            if not len(rays):
                break
            place = origin + reach * rays
            place = place[(place[:, 2] >= self._band[0]) & (place[:, 2] < self._band[1]), :2]
            cell = np.floor((place - truth.position[:2]) / truth.resolution).astype(int)
            cell = cell[(cell >= 0).all(axis=1) & (cell < met.shape[::-1]).all(axis=1)]
            met[cell[:, 1], cell[:, 0]] = True
        return met
