"""Sinks that score streams against ground truth."""

from operators.evaluation.trajectory_metrics import TrajectoryMetrics

__all__ = ["TrajectoryMetrics"]
