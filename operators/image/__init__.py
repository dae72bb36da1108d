"""Operators that prepare images: without distortion, rectified, cropped, scaled, evenly bright."""

from operators.image.image_preprocess import ImagePreprocess
from operators.image.stereo_preprocess import StereoPreprocess

__all__ = ["ImagePreprocess", "StereoPreprocess"]
