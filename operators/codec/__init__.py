"""Compressed images, depth images and video, and back."""

from operators.codec.decoder import DepthDecoder, ImageDecoder
from operators.codec.video_decoder import VideoDecoder

__all__ = ["DepthDecoder", "ImageDecoder", "VideoDecoder"]
