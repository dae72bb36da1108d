"""The two images of one stereo frame, and what is wrong with them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.monitoring.image_flaws import Watch
from operators.odometry.features import Gray

Watches = tuple[Watch, Watch]


@dataclass(frozen=True, eq=False)
class StereoPair:
    """A rectified pair in grey at a stamp; `flaw` is the reason if it is not used."""

    stamp: int
    left: Gray
    right: Gray
    flaw: str | None
    watches: Watches  # to compare the next pair with


def observe(left: NDArray[np.uint8], right: NDArray[np.uint8], stamp: int, last: Watches) -> StereoPair:
    """Looks for flaws of two (H, W) or (H, W, 3) RGB uint8 images, such as repeating those last watched.

    Raises ValueError for a wrong shape or type.
    """
    for name, image in (("left", left), ("right", right)):
        if image.dtype != np.uint8 or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
            raise ValueError(f"{name} must be (H, W) or (H, W, 3) uint8, got {image.shape} {image.dtype}")
        if min(image.shape[:2]) < 32:
            raise ValueError(f"{name} must be at least 32 x 32 pixels, got {image.shape}")
    if left.shape[:2] != right.shape[:2]:
        raise ValueError(f"left and right differ in size: {left.shape[:2]} and {right.shape[:2]}")
    grays = _gray(left), _gray(right)
    none, flaws = np.zeros((1, 1), np.float32), list[str]()
    watches = Watch().seen(grays[0], none), Watch().seen(grays[1], none)
    for name, gray, watch, before in zip(("left", "right"), grays, watches, last, strict=True):
        flaw = watch.image_flaw(before, gray)
        if flaw is not None:
            flaws.append(f"{name} image {flaw}")
    return StereoPair(stamp, *grays, "; ".join(flaws) or None, watches)


def _gray(image: NDArray[np.uint8]) -> Gray:
    gray = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    return np.ascontiguousarray(gray)
