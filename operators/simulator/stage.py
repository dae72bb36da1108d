"""The world at the times at which it is measured: where the robot is, and what a camera on it sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from operators.simulator.drive import Drive, Shake
from operators.simulator.rendering.optics import Optics, View
from operators.simulator.rendering.renderer import Renderer, always_on
from operators.simulator.scene import World

Array = NDArray[np.float64]


class Stage:
    """Sensors that measure at one time from one place share one cast."""

    def __init__(
        self,
        world: World,
        seed: int,
        *,
        threads: int = 1,
        shakes: Sequence[Shake] = (),
        level: Callable[[float], float] = always_on,
    ) -> None:
        self.world = world
        self.drive = Drive(world.path, shakes)
        self._seed, self._threads, self._level = seed, threads, level
        self._last: tuple[tuple[float, bytes, Optics], View] | None = None

    @cached_property
    def renderer(self) -> Renderer:
        """Made when it is first asked for: sensors that cast no rays need none. Raises ImportError without Open3D."""
        return Renderer(self.world, self._seed, threads=self._threads, level=self._level)

    def T_world_base(self, t: float) -> Array:
        """(4, 4)."""
        return np.asarray(self.drive.poses([t])[0])

    def at(self, t: float) -> Renderer:
        """The renderer, set to a time."""
        self.renderer.at(t)
        return self.renderer

    def view(self, t: float, T_base_camera: Array, optics: Optics, *, color: bool) -> View:
        """Returns what a camera on the robot sees at a time."""
        key = (t, T_base_camera.tobytes(), optics)
        if self._last is not None and self._last[0] == key and (self._last[1].color is not None or not color):
            return self._last[1]
        view = self.at(t).view(self.T_world_base(t) @ T_base_camera, optics, color=color)
        self._last = (key, view)
        return view
