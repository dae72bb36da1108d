"""Estimation of state from several sensors."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.fusion.ekf import EkfFusion
    from operators.fusion.orientation_filter import OrientationFilter
    from operators.fusion.redundant.pose_fusion import PoseFusion
    from operators.fusion.redundant.position_fusion import PositionFusion
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "ekf": ("EkfFusion",),
            "orientation_filter": ("OrientationFilter",),
            "redundant.pose_fusion": ("PoseFusion",),
            "redundant.position_fusion": ("PositionFusion",),
        },
    )

__all__ = ["EkfFusion", "OrientationFilter", "PoseFusion", "PositionFusion"]
