"""Estimation of state from several sensors."""

from operators.fusion.ekf import EkfFusion
from operators.fusion.orientation_filter import OrientationFilter

__all__ = ["EkfFusion", "OrientationFilter"]
