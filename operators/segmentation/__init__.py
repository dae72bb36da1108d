"""Operators that give every pixel a class."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.segmentation.segmenter import Segmenter
    from operators.segmentation.torchvision_segmenter import TorchvisionSegmenter
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "segmenter": ("Segmenter",),
            "torchvision_segmenter": ("TorchvisionSegmenter",),
        },
    )

__all__ = ["Segmenter", "TorchvisionSegmenter"]
