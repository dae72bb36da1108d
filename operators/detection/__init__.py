"""Operators that find objects in images."""

from operators.detection.onnx_detector import OnnxDetector

__all__ = ["OnnxDetector"]
