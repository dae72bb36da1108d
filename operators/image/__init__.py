"""Operators that prepare images: without distortion, rectified, cropped, scaled, evenly bright, adapted, none twice."""

from operators.image.image_adapter import ImageAdapter
from operators.image.image_preprocess import ImagePreprocess
from operators.image.stereo_preprocess import StereoPreprocess
from operators.image.watch import DepthWatch, ImageWatch

__all__ = ["DepthWatch", "ImageAdapter", "ImagePreprocess", "ImageWatch", "StereoPreprocess"]
