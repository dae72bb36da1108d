"""Operators that find objects in images."""

from operators.detection.custom_detector import CustomDetector
from operators.detection.onnx_detector import OnnxDetector

__all__ = ["CustomDetector", "OnnxDetector"]
