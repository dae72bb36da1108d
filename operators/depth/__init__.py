"""Operators that make and change depth images."""

from operators.depth.depth_filter import DepthFilter

__all__ = ["DepthFilter"]
