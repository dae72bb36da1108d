"""Odometry: how a robot moved, from frame to frame."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.odometry.base_odometry import BaseOdometry
    from operators.odometry.lidar_odometry import LidarOdometry
    from operators.odometry.mono_visual_odometry import MonoVisualOdometry
    from operators.odometry.stereo_visual_odometry import StereoVisualOdometry
    from operators.odometry.visual_odometry import VisualOdometry
    from operators.odometry.wheel_odometry import WheelOdometry
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "base_odometry": ("BaseOdometry",),
            "lidar_odometry": ("LidarOdometry",),
            "mono_visual_odometry": ("MonoVisualOdometry",),
            "stereo_visual_odometry": ("StereoVisualOdometry",),
            "visual_odometry": ("VisualOdometry",),
            "wheel_odometry": ("WheelOdometry",),
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
