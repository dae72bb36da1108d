"""Operators that make and change depth images."""

from operators.depth.depth_filter import DepthFilter
from operators.depth.stereo_depth import StereoDepth

__all__ = ["DepthFilter", "StereoDepth"]
