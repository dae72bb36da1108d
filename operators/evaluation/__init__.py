"""Scores streams against ground truth, and draws their errors."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.evaluation.consistency_metrics import ConsistencyMetrics
    from operators.evaluation.depth_metrics import DepthMetrics
    from operators.evaluation.detection_metrics import DetectionMetrics
    from operators.evaluation.orientation_metrics import OrientationMetrics
    from operators.evaluation.scene_graph_metrics import SceneGraphMetrics
    from operators.evaluation.segmentation_metrics import SegmentationMetrics
    from operators.evaluation.surface_metrics import SurfaceMetrics
    from operators.evaluation.trajectory_metrics import TrajectoryMetrics
    from operators.evaluation.trajectory_plots import TrajectoryPlots
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "consistency_metrics": ("ConsistencyMetrics",),
            "depth_metrics": ("DepthMetrics",),
            "detection_metrics": ("DetectionMetrics",),
            "orientation_metrics": ("OrientationMetrics",),
            "scene_graph_metrics": ("SceneGraphMetrics",),
            "segmentation_metrics": ("SegmentationMetrics",),
            "surface_metrics": ("SurfaceMetrics",),
            "trajectory_metrics": ("TrajectoryMetrics",),
            "trajectory_plots": ("TrajectoryPlots",),
        },
    )

__all__ = [
    "ConsistencyMetrics",
    "DepthMetrics",
    "DetectionMetrics",
    "OrientationMetrics",
    "SceneGraphMetrics",
    "SegmentationMetrics",
    "SurfaceMetrics",
    "TrajectoryMetrics",
    "TrajectoryPlots",
]
