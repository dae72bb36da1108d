"""Odometry of LiDARs."""
