"""Odometry of single cameras, with an unknown or a measured scale."""
