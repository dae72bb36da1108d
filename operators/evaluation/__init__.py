"""Sinks that score streams against ground truth."""

from operators.evaluation.consistency_metrics import ConsistencyMetrics
from operators.evaluation.depth_metrics import DepthMetrics
from operators.evaluation.detection_metrics import DetectionMetrics
from operators.evaluation.orientation_metrics import OrientationMetrics
from operators.evaluation.scene_graph_metrics import SceneGraphMetrics
from operators.evaluation.segmentation_metrics import SegmentationMetrics
from operators.evaluation.trajectory_metrics import TrajectoryMetrics

__all__ = [
    "ConsistencyMetrics",
    "DepthMetrics",
    "DetectionMetrics",
    "OrientationMetrics",
    "SceneGraphMetrics",
    "SegmentationMetrics",
    "TrajectoryMetrics",
]
