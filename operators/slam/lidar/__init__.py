"""SLAM with a LiDAR."""
