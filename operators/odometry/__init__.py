"""Odometry: how a robot moved, from frame to frame."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.odometry.base_odometry import BaseOdometry
    from operators.odometry.lidar.odometry import LidarOdometry
    from operators.odometry.mono.odometry import MonoVisualOdometry
    from operators.odometry.rgbd.odometry import VisualOdometry
    from operators.odometry.stereo.odometry import StereoVisualOdometry
    from operators.odometry.wheels.odometry import WheelOdometry
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "base_odometry": ("BaseOdometry",),
            "lidar.odometry": ("LidarOdometry",),
            "mono.odometry": ("MonoVisualOdometry",),
            "rgbd.odometry": ("VisualOdometry",),
            "stereo.odometry": ("StereoVisualOdometry",),
            "wheels.odometry": ("WheelOdometry",),
        },
    )

__all__ = [
    "BaseOdometry",
    "LidarOdometry",
    "MonoVisualOdometry",
    "StereoVisualOdometry",
    "VisualOdometry",
    "WheelOdometry",
]
