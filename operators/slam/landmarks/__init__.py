"""SLAM with point landmarks."""
