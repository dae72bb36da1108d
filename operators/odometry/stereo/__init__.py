"""Odometry of stereo cameras."""
