"""Simultaneous localisation and mapping."""

from operators.slam.landmark_slam import LandmarkSlam

__all__ = ["LandmarkSlam"]
