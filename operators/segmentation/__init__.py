"""Operators that give every pixel a class."""

from operators.segmentation.segmenter import Segmenter
from operators.segmentation.torchvision_segmenter import TorchvisionSegmenter

__all__ = ["Segmenter", "TorchvisionSegmenter"]
