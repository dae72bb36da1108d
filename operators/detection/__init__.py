"""Operators that find objects in images."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.detection.box_segmenter import BoxSegmenter
    from operators.detection.custom_detector import CustomDetector
    from operators.detection.drawing import draw_detections
    from operators.detection.keypoint_detector import KeypointDetector
    from operators.detection.onnx_detector import OnnxDetector, OnnxRigDetector
    from operators.detection.score_filter import ScoreFilter
    from operators.detection.torchvision_detector import TorchvisionDetector, TorchvisionRigDetector
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "box_segmenter": ("BoxSegmenter",),
            "custom_detector": ("CustomDetector",),
            "drawing": ("draw_detections",),
            "keypoint_detector": ("KeypointDetector",),
            "onnx_detector": ("OnnxRigDetector", "OnnxDetector"),
            "score_filter": ("ScoreFilter",),
            "torchvision_detector": ("TorchvisionRigDetector", "TorchvisionDetector"),
        },
    )

__all__ = [
    "BoxSegmenter",
    "CustomDetector",
    "KeypointDetector",
    "OnnxDetector",
    "OnnxRigDetector",
    "ScoreFilter",
    "TorchvisionDetector",
    "TorchvisionRigDetector",
    "draw_detections",
]
