"""Operators that check sensors against each other: a disagreement is said before anything averages it."""

from operators.crosscheck.color_depth_check import ColorDepthCheck
from operators.crosscheck.depth_scan_check import DepthScanCheck
from operators.crosscheck.motion_check import MotionCheck

__all__ = ["ColorDepthCheck", "DepthScanCheck", "MotionCheck"]
