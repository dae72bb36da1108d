"""Camera calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from dataflow.messages.arrays import F64
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import finite, positive

COEFFICIENTS: dict[str, tuple[int, ...]] = {
    "none": (0,),
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8, 12, 14),
    "equidistant": (4,),
}
"""Coefficients taken by the distortion models known here (OpenCV's order); any other model is passed on as it is."""


class CameraInfo(Message):
    """Intrinsic calibration of one camera; usually a static stream.

    Distortion models are named as in ROS: `plumb_bob` (k1, k2, p1, p2[, k3]), `rational_polynomial` (k1, k2, p1, p2,
    k3, k4, k5, k6[, ...]), `equidistant` (fisheye, k1..k4), and `none`.
    """

    frame: str = scalar("str", "optical frame of the camera (z forward, x right, y down)", default=ANCHOR)
    width: int = scalar("int", "columns of the image that `K` belongs to, pixels")
    height: int = scalar("int", "rows of the image that `K` belongs to, pixels")
    distortion_model: str = scalar("str", "name of the lens model, `none` for an ideal pinhole", default="none")
    K: F64 = array("float64", "3 3", "intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of the raw image", unit="px")
    distortion: F64 | None = array("float64", "N", "coefficients of the lens model; None for none", default=None)
    R: F64 | None = array("float64", "3 3", "rectification rotation (stereo); None for identity", default=None)
    P: F64 | None = array(
        "float64",
        "3 4",
        "projection of the rectified image, P[0, 3] = -fx * baseline; None where not known",
        unit="px",
        default=None,
    )

    def validate(self) -> None:
        positive(self, "width", "height")
        finite(self, "K", "distortion", "R", "P")
        if not (self.K[0, 0] > 0 and self.K[1, 1] > 0):
            raise MessageError(
                f"CameraInfo.K must have focal lengths above zero at K[0, 0] and K[1, 1], got {self.fx} and {self.fy}"
            )
        if self.K[2].tolist() != [0.0, 0.0, 1.0]:
            raise MessageError(f"CameraInfo.K must have [0, 0, 1] as its last row, got {self.K[2].tolist()}")
        counts = COEFFICIENTS.get(self.distortion_model)
        given = 0 if self.distortion is None else len(self.distortion)
        if counts is not None and given not in counts:
            raise MessageError(
                f"CameraInfo.distortion must have {' or '.join(map(str, counts))} coefficients for the model "
                f"{self.distortion_model!r}, got {given}"
            )

    @classmethod
    def from_intrinsics(
        cls,
        *,
        stamp: int,
        frame: str,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        distortion_model: str = "none",
        distortion: Sequence[float] | None = None,
    ) -> Self:
        """A calibration from focal lengths and principal point in pixels."""
        return cls(
            stamp=stamp,
            frame=frame,
            width=width,
            height=height,
            distortion_model=distortion_model,
            K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion=None if distortion is None else np.asarray(distortion, np.float64),
        )

    @property
    def fx(self) -> float:
        """Focal length along x, pixels."""
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        """Focal length along y, pixels."""
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        """Principal point, column."""
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        """Principal point, row."""
        return float(self.K[1, 2])
