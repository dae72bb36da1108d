"""Pictures of three shapes on noisy grounds, to be told apart."""

from __future__ import annotations

import cv2
import numpy as np

from dataflow.messages import Detections2D, Image

SHAPES = ("cross", "disc", "stripes")


def picture(shape: str, seed: int) -> np.ndarray:
    """A bright shape of any colour on a noisy dark ground, 64x64."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 60, (64, 64, 3), dtype=np.uint8)
    color = tuple(int(c) for c in rng.integers(140, 255, 3))
    x, y = (int(v) for v in rng.integers(26, 38, 2))
    if shape == "disc":
        cv2.circle(pixels, (x, y), 14, color, -1)
    elif shape == "cross":
        cv2.line(pixels, (x - 16, y - 16), (x + 16, y + 16), color, 5)
        cv2.line(pixels, (x - 16, y + 16), (x + 16, y - 16), color, 5)
    else:
        for row in range(y - 18, y + 18, 9):
            cv2.line(pixels, (4, row), (60, row), color, 3)
    return pixels


def image(pixels: np.ndarray, stamp: int = 0) -> Image:
    return Image(stamp=stamp, frame="camera", data=pixels)


def scene() -> tuple[Image, Detections2D]:
    """A disc at the left, stripes at the right, and where they are."""
    pixels = np.concatenate([picture("disc", 901), picture("stripes", 902)], axis=1)
    boxes = Detections2D(
        stamp=0, frame="camera", width=128, height=64, class_names=("thing",),
        boxes=[[0, 0, 64, 64], [64, 0, 128, 64]], scores=[1, 1], class_ids=[0, 0], ids=[7, 9],
    )  # fmt: skip
    return image(pixels), boxes
