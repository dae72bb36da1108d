"""Operators that give every pixel a class."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.segmentation.drawing import draw_segmentation
    from operators.segmentation.onnx_segmenter import OnnxSegmenter
    from operators.segmentation.segmenter import Segmenter
    from operators.segmentation.torchvision_segmenter import TorchvisionRigSegmenter, TorchvisionSegmenter
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "drawing": ("draw_segmentation",),
            "onnx_segmenter": ("OnnxSegmenter",),
            "segmenter": ("Segmenter",),
            "torchvision_segmenter": ("TorchvisionRigSegmenter", "TorchvisionSegmenter"),
        },
    )

__all__ = ["OnnxSegmenter", "Segmenter", "TorchvisionRigSegmenter", "TorchvisionSegmenter", "draw_segmentation"]
