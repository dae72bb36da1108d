"""Takes from a message of detections what a score needs of the objects of one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D


@dataclass(frozen=True, eq=False)
class Objects:
    """Holds size (width, height) of an image, boxes (N, 4) in its pixels, class names, scores, which are ignored."""

    size: NDArray[np.float64]
    boxes: NDArray[np.float64]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]
    ignored: NDArray[np.bool_]


def objects_of(message: Detections2D, ignored: NDArray[np.bool_] | None = None) -> Objects:
    """Returns the objects of one image; `ignored`: those that do not count, none if not given."""
    return Objects(
        np.array([message.width, message.height], np.float64),
        message.boxes.astype(np.float64),
        message.labels(),
        message.scores,
        np.zeros(message.count, np.bool_) if ignored is None else ignored,
    )
