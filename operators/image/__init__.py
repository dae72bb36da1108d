"""Operators that prepare images: without distortion, rectified, cropped, scaled, evenly bright, adapted."""

from operators.image.image_adapter import ImageAdapter
from operators.image.image_preprocess import ImagePreprocess
from operators.image.stereo_preprocess import StereoPreprocess

__all__ = ["ImageAdapter", "ImagePreprocess", "StereoPreprocess"]
