"""Simultaneous localisation and mapping."""

from operators.slam.landmark_slam import LandmarkSlam
from operators.slam.lidar_slam import LidarSlam
from operators.slam.visual_slam import VisualSlam

__all__ = ["LandmarkSlam", "LidarSlam", "VisualSlam"]
