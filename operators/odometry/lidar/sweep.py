"""Times of a turning LiDAR's points, derived from their azimuth if the messages hold none."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

_STAMPED = {"begin": 0.0, "middle": 0.5, "end": 1.0}


class Sweep(BaseModel):
    """Holds how a LiDAR turns about its z axis, at constant speed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    period: float = Field(gt=0, le=10, description="seconds that a turn takes")
    begins: float = Field(0.0, description="azimuth at which it begins, radians from x towards y")
    clockwise: bool = Field(False, description="seen from above")
    stamped: Literal["begin", "middle", "end"] = Field("end", description="moment of the turn that stamps tell")

    def offsets(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns when each of the points (N, 3) was measured after the stamp (N,), seconds; NaN where a point is.

        As in Zhang and Singh, "LOAM: lidar odometry and mapping in real-time", 2014.
        """
        azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
        turned = np.mod((self.begins - azimuth) if self.clockwise else (azimuth - self.begins), 2 * math.pi)
        return ((turned / (2 * math.pi) - _STAMPED[self.stamped]) * self.period).astype(np.float32)
