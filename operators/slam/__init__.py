"""Simultaneous localisation and mapping."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.slam.landmarks.slam import LandmarkSlam
    from operators.slam.lidar.slam import LidarSlam
    from operators.slam.visual.slam import VisualSlam
else:  # each needs another part of scipy
    __getattr__, __dir__ = lazily(
        __name__, {"landmarks.slam": ("LandmarkSlam",), "lidar.slam": ("LidarSlam",), "visual.slam": ("VisualSlam",)}
    )

__all__ = ["LandmarkSlam", "LidarSlam", "VisualSlam"]
