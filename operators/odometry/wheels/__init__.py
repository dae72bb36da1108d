"""Odometry of driven wheels."""
