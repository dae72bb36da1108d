"""Operators about the frames of a robot: where they are, and what of the robot its sensors see."""

from operators.frames.self_filter import DepthSelfFilter, SelfFilter
from operators.frames.transform_tree import TransformTree

__all__ = ["DepthSelfFilter", "SelfFilter", "TransformTree"]
