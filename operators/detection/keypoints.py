"""Keypoints of what is in a box: the part of the image that a network sees, and points from its answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.detection.decode import Outputs, Size, shapes_of
from operators.network_input import NORMALIZATIONS

F32 = NDArray[np.float32]
KeypointDecoderName = Literal["simcc", "movenet"]

COCO_KEYPOINTS: Final = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle",
    "right_ankle",
)  # fmt: skip
"""The 17 points of a person in COCO, in its order."""

COCO_LINKS: Final = (
    (0, 1), (0, 2), (1, 3), (2, 4), (5, 6), (5, 7), (7, 9), (6, 8), (8, 10), (5, 11), (6, 12), (11, 12), (11, 13),
    (13, 15), (12, 14), (14, 16),
)  # fmt: skip


@dataclass(frozen=True)
class Cut:
    """The part of an image that fills a network's input: around `center` (x, y), `extent` (w, h) pixels of the image.

    It has the aspect ratio of the input, so that nothing is stretched; what is outside the image is black.
    """

    center: tuple[float, float]
    extent: tuple[float, float]
    size: Size

    @classmethod
    def around(cls, box: Sequence[float], size: Size, padding: float) -> Cut:
        """Returns the cut around a box (x1, y1, x2, y2), made larger by a factor.

        Source: `bbox_xyxy2cs` and `TopdownAffine` of MMPose (Apache-2.0).
        """
        x1, y1, x2, y2 = box
        width, height, aspect = (x2 - x1) * padding, (y2 - y1) * padding, size[0] / size[1]
        extent = (width, width / aspect) if width > height * aspect else (height * aspect, height)
        return cls(((x1 + x2) / 2, (y1 + y2) / 2), extent, size)

    def of(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Returns the input (h, w, 3) of an image (H, W, 3)."""
        scale = self.size[0] / self.extent[0]
        shift = [extent / 2 - scale * middle for extent, middle in zip(self.size, self.center, strict=True)]
        matrix = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        return np.asarray(cv2.warpAffine(pixels, matrix, self.size, flags=cv2.INTER_LINEAR), np.uint8)

    def restore(self, points: F32) -> F32:
        """Returns points (K, 2) of the input as points of the image."""
        center, extent = np.array(self.center), np.array(self.extent)
        return np.asarray(points / np.array(self.size) * extent + center - extent / 2, np.float32)


def decode_simcc(outputs: Outputs, size: Size) -> tuple[F32, F32]:
    """RTMPose and others of SimCC: two distributions over the input's columns (N, K, Wx) and rows (N, K, Wy).

    A point is where both are largest; the smaller one of the two values is its score. NaN where that is not above 0.
    Source: `get_simcc_maximum` of MMPose (Apache-2.0), after Li et al., "SimCC", 2022, and Jiang et al., "RTMPose",
    2023.
    """
    if len(outputs) != 2 or any(o.ndim != 3 for o in outputs) or outputs[0].shape[:2] != outputs[1].shape[:2]:
        raise ValueError(f"SimCC's outputs are (N, K, Wx) and (N, K, Wy), got {shapes_of(outputs)}")
    places = np.stack([o.argmax(axis=2) * (side / o.shape[2]) for o, side in zip(outputs, size, strict=True)], axis=2)
    scores = np.minimum(*(o.max(axis=2) for o in outputs)).astype(np.float32)
    points = places.astype(np.float32)
    points[scores <= 0] = np.nan
    return points, scores


def decode_movenet(outputs: Outputs, size: Size) -> tuple[F32, F32]:
    """MoveNet for one person: (N, 1, K, 3), rows and columns as shares of the input, and scores.

    Source: the model card of MoveNet.SinglePose (Google, 2021; Apache-2.0).
    """
    answer = outputs[0]
    if answer.ndim != 4 or answer.shape[1] != 1 or answer.shape[3] != 3:
        raise ValueError(f"MoveNet's output is (N, 1, K, 3), got {shapes_of(outputs)}")
    rows = answer[:, 0].astype(np.float32)
    return rows[:, :, 1::-1] * np.array(size, np.float32), rows[:, :, 2]


@dataclass(frozen=True)
class KeypointLayout:
    """One family: how its outputs become points (N, K, 2) of the input and scores, and how its input is made.

    `padding` is the factor by which boxes are made larger, `normalization` one of `NORMALIZATIONS`.
    """

    decode: Callable[[Outputs, Size], tuple[F32, F32]]
    padding: float
    normalization: str

    @property
    def scaling(self) -> tuple[Any, Any]:
        """Mean and scale of pixels."""
        return NORMALIZATIONS[self.normalization]


KEYPOINT_LAYOUTS: dict[KeypointDecoderName, KeypointLayout] = {
    "simcc": KeypointLayout(decode_simcc, 1.25, "imagenet"),
    "movenet": KeypointLayout(decode_movenet, 1.0, "none"),
}
