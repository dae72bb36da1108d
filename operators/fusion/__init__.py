"""Estimation of state from several sensors."""

from operators.fusion.orientation_filter import OrientationFilter

__all__ = ["OrientationFilter"]
