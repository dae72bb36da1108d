"""Compressed images and depth images, and back."""

from operators.codec.decoder import DepthDecoder, ImageDecoder

__all__ = ["DepthDecoder", "ImageDecoder"]
