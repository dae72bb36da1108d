"""SLAM with an RGB-D camera."""
