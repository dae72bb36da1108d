"""Operators that give every pixel a class."""

from operators.segmentation.segmenter import Segmenter

__all__ = ["Segmenter"]
