"""Estimation of state from several sensors."""

from operators.fusion.ekf import EkfFusion
from operators.fusion.orientation_filter import OrientationFilter
from operators.fusion.pose_fusion import PoseFusion
from operators.fusion.position_fusion import PositionFusion

__all__ = ["EkfFusion", "OrientationFilter", "PoseFusion", "PositionFusion"]
