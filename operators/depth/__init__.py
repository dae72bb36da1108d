"""Operators that make and change depth images."""

from operators.depth.depth_filter import DepthFilter
from operators.depth.mono_depth import MonoDepth
from operators.depth.stereo_depth import StereoDepth

__all__ = ["DepthFilter", "MonoDepth", "StereoDepth"]
