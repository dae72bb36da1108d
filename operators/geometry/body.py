"""The body of a robot as boxes and cylinders, and which points lie in it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.geometry.se3 import Matrix

Mask = NDArray[np.bool_]
Points = NDArray[np.floating]


class BodyPart(BaseModel):
    """A box or an upright cylinder on one of the robot's frames."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    shape: Literal["box", "cylinder"] = Field(description="a cylinder's axis is z")
    size: tuple[float, float, float] = Field(
        description="extents along x, y and z, metres; a cylinder's x and y are its diameter"
    )
    position: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="of its middle, metres")
    rotation: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="about the fixed x, then y, then z axis, radians"
    )
    frame: str = Field("", description="frame that it is fixed to; the robot's own where empty")

    @model_validator(mode="after")
    def _is_solid(self) -> BodyPart:
        """Raises ValueError for extents that hold nothing, and for a cylinder that is not round."""
        if not all(math.isfinite(x) and x > 0 for x in self.size):
            raise ValueError(f"size must be above 0, got {list(self.size)}")
        if self.shape == "cylinder" and self.size[0] != self.size[1]:
            raise ValueError(f"a cylinder's size must have one diameter in x and y, got {list(self.size)}")
        return self

    def pose(self) -> Matrix:
        """Returns `T_frame_part` (4, 4)."""
        T: Matrix = np.eye(4)
        for axis in (2, 1, 0):
            turn = np.zeros(6)
            turn[3 + axis] = self.rotation[axis]
            T = T @ se3.exp(turn)
        T[:3, 3] = self.position
        return T

    def holds(self, points: Points, padding: float) -> Mask:
        """Returns which points (N, 3) in the part's own axes lie in it, or within `padding` of its sides."""
        reach = np.asarray(self.size) / 2 + padding
        inside = np.abs(points[:, 2]) <= reach[2]
        if self.shape == "box":
            return np.asarray(inside & (np.abs(points[:, :2]) <= reach[:2]).all(axis=1))
        return np.asarray(inside & ((points[:, :2] ** 2).sum(axis=1) <= reach[0] ** 2))

    def radius(self, padding: float) -> float:
        """Returns how far the part reaches from its middle, metres."""
        return float(np.linalg.norm(np.asarray(self.size) / 2 + padding))


def in_body(points: Points, parts: Sequence[tuple[BodyPart, Matrix]], padding: float) -> Mask:
    """Returns which points (N, 3) lie in a part; with each part comes `T_points_part` (4, 4). NaN lies in none."""
    found = np.zeros(len(points), np.bool_)
    for part, T in parts:
        near = np.flatnonzero(
            (np.abs(points - T[:3, 3].astype(points.dtype)) <= part.radius(padding)).all(axis=1) & ~found
        )
        T_part_points = invert(T)
        found[near] = part.holds(points[near] @ T_part_points[:3, :3].T + T_part_points[:3, 3], padding)
    return found
