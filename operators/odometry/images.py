"""The images that visual odometries work on: checked, grey, and reduced by whole factors."""

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.odometry.features import Gray


def check_image(name: str, image: NDArray[np.uint8]) -> None:
    """Raises ValueError unless an image is grey or RGB, and large enough for corners."""
    if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"{name} must be (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
    check_size(name, image.shape)


def check_size(name: str, shape: tuple[int, ...]) -> None:
    if min(shape[:2]) < 32:
        raise ValueError(f"{name} must be at least 32 x 32 pixels, got {shape}")


def gray_of(image: NDArray[np.uint8]) -> Gray:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def reduced(gray: Gray, factor: int) -> Gray:
    """Returns an image smaller by a whole factor."""
    if factor == 1:
        return gray
    height, width = gray.shape[0] // factor, gray.shape[1] // factor
    whole = gray[: height * factor, : width * factor]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
