"""Operators that prepare images: without distortion, rectified, cropped, scaled, evenly bright, adapted."""

from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from operators.image.image_adapter import ImageAdapter
    from operators.image.image_preprocess import ImagePreprocess
    from operators.image.stereo_preprocess import StereoPreprocess
else:
    __getattr__, __dir__ = lazily(
        __name__,
        {
            "image_adapter": ("ImageAdapter",),
            "image_preprocess": ("ImagePreprocess",),
            "stereo_preprocess": ("StereoPreprocess",),
        },
    )

__all__ = ["ImageAdapter", "ImagePreprocess", "StereoPreprocess"]
