"""Scores streams against ground truth, and draws their errors."""

from operators.evaluation.consistency_metrics import ConsistencyMetrics
from operators.evaluation.depth_metrics import DepthMetrics
from operators.evaluation.detection_metrics import DetectionMetrics
from operators.evaluation.orientation_metrics import OrientationMetrics
from operators.evaluation.segmentation_metrics import SegmentationMetrics
from operators.evaluation.trajectory_metrics import TrajectoryMetrics
from operators.evaluation.trajectory_plots import TrajectoryPlots

__all__ = [
    "ConsistencyMetrics",
    "DepthMetrics",
    "DetectionMetrics",
    "OrientationMetrics",
    "SegmentationMetrics",
    "TrajectoryMetrics",
    "TrajectoryPlots",
]
