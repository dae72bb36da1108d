"""Simultaneous localisation and mapping."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.slam.landmark_slam import LandmarkSlam
    from operators.slam.lidar_slam import LidarSlam
    from operators.slam.visual_slam import VisualSlam
else:  # each needs another part of scipy
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "landmark_slam": ("LandmarkSlam",),
            "lidar_slam": ("LidarSlam",),
            "visual_slam": ("VisualSlam",),
        },
    )

__all__ = ["LandmarkSlam", "LidarSlam", "VisualSlam"]
