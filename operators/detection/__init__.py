"""Operators that find objects in images."""

from operators.detection.custom_detector import CustomDetector
from operators.detection.onnx_detector import OnnxDetector
from operators.detection.score_filter import ScoreFilter
from operators.detection.torchvision_detector import TorchvisionDetector

__all__ = ["CustomDetector", "OnnxDetector", "ScoreFilter", "TorchvisionDetector"]
