"""Notices images that show nothing: black, without contrast, or the last one over again."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
import xxhash
from numpy.typing import NDArray


class Flaw(StrEnum):
    """Reasons for which an image is not used."""

    BLACK = "is black"
    BLANK = "has no contrast"
    FROZEN = "repeats the last one"
    EMPTY = "has no return"


@dataclass(frozen=True)
class Watch:
    """Digests of the last images. Two exposures of a real sensor are never equal bit by bit."""

    image: bytes = b""
    depth: bytes = b""

    def seen(self, image: NDArray[np.uint8], depth: NDArray[np.float32]) -> "Watch":
        return Watch(_digest(image), _digest(depth))

    def image_flaw(self, last: "Watch", gray: NDArray[np.uint8]) -> Flaw | None:
        """Returns what is wrong with this watch's image, whose working copy is gray, after the last one."""
        mean, spread = (float(x[0, 0]) for x in cv2.meanStdDev(gray))
        if spread < 4.0:
            return Flaw.BLACK if mean < 16.0 else Flaw.BLANK
        return Flaw.FROZEN if self.image == last.image else None

    def depth_flaw(self, last: "Watch", coverage: float) -> Flaw | None:
        """Returns what is wrong with this watch's depth image, of which a share is covered by surfaces."""
        if coverage < 0.01:
            return Flaw.EMPTY
        return Flaw.FROZEN if self.depth == last.depth else None


def _digest(array: NDArray[Any]) -> bytes:
    return xxhash.xxh3_128_digest(np.ascontiguousarray(array).data)
