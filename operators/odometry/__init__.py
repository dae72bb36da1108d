"""Odometry: how a robot moved, from frame to frame."""

from operators.odometry.visual_odometry import VisualOdometry

__all__ = ["VisualOdometry"]
