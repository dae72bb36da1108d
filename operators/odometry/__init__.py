"""Odometry: how a robot moved, from frame to frame."""

from operators.odometry.base_odometry import BaseOdometry
from operators.odometry.lidar_odometry import LidarOdometry
from operators.odometry.stereo_visual_odometry import StereoVisualOdometry
from operators.odometry.visual_odometry import VisualOdometry

__all__ = ["BaseOdometry", "LidarOdometry", "StereoVisualOdometry", "VisualOdometry"]
