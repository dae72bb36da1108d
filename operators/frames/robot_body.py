"""The robot's body in the frame of one of its sensors, from extrinsics and, where parts move, transforms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dataflow.messages import Transforms
from operators.geometry.body import BodyPart
from operators.geometry.frame_tree import FrameTree, told_by
from operators.geometry.se3 import Matrix


class RobotBody:
    """Parts of a robot, each on a frame of the tree that the given transforms make."""

    def __init__(self, parts: Sequence[BodyPart], base_frame: str) -> None:
        self._parts, self._base = parts, base_frame
        self._known: dict[str, Transforms] | None = None
        self._seen: dict[str, list[tuple[BodyPart, Matrix]]] = {}

    def seen_from(self, sensor: str, transforms: Mapping[str, Transforms]) -> list[tuple[BodyPart, Matrix]]:
        """Returns each part with `T_sensor_part` (4, 4), by the newest transforms of each stream.

        Raises ValueError where a transform on the way is missing, or they contradict each other.
        """
        if self._known is None or any(self._known.get(name) is not given for name, given in transforms.items()):
            self._known, self._seen = dict(transforms), {}
        if sensor not in self._seen:
            tree = FrameTree()
            for given in transforms.values():
                for told in told_by(given):
                    tree.fix(*told)
            self._seen[sensor] = [
                (part, self._place(tree, sensor, part.frame or self._base) @ part.pose()) for part in self._parts
            ]
        return self._seen[sensor]

    @staticmethod
    def _place(tree: FrameTree, sensor: str, frame: str) -> Matrix:
        if sensor == frame:
            return np.eye(4)
        return tree.lookup(sensor, frame, 0)
