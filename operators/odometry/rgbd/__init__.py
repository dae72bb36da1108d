"""Odometry of RGB-D cameras."""
