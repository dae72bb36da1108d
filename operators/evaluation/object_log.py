"""The objects of many images in a few arrays: some 40 bytes an object, so that a score may last for hours."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D


@dataclass(frozen=True, eq=False)
class Objects:
    """Holds what scoring needs of an image: boxes (N, 4) in pixels, class names, scores, which objects are ignored."""

    size: NDArray[np.float64]
    boxes: NDArray[np.float64]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]
    ignored: NDArray[np.bool_]


class ObjectLog:
    """Collects the objects of one stream's images in the order in which they come."""

    def __init__(self) -> None:
        self.stamps = array("q")
        self._ends = array("q", [0])
        self._sizes = array("i")
        self._boxes, self._scores = array("f"), array("f")
        self._ignored = bytearray()
        self._classes = array("i")
        self._names: list[str] = []
        self._numbers: dict[str, int] = {}

    def __len__(self) -> int:
        return len(self.stamps)

    def add(self, message: Detections2D, ignored: NDArray[np.bool_] | None = None) -> None:
        """Takes the objects of one image; `ignored`: those that do not count, none if not given."""
        self.stamps.append(message.stamp)
        self._sizes.extend((message.width, message.height))
        self._boxes.frombytes(np.asarray(message.boxes, np.float32).tobytes())
        self._scores.frombytes(np.asarray(message.scores, np.float32).tobytes())
        self._ignored += (np.zeros(message.count, np.bool_) if ignored is None else ignored).tobytes()
        for name in message.labels():
            number = self._numbers.setdefault(name, len(self._names))
            if number == len(self._names):
                self._names.append(name)
            self._classes.append(number)
        self._ends.append(len(self._classes))

    def image(self, index: int) -> Objects:
        """The objects of one image, by its place in `stamps`."""
        first, end = self._ends[index : index + 2]
        return Objects(
            np.array(self._sizes[2 * index : 2 * index + 2], np.float64),
            np.array(self._boxes[4 * first : 4 * end], np.float64).reshape(-1, 4),
            tuple(self._names[number] for number in self._classes[first:end]),
            np.array(self._scores[first:end], np.float32),
            np.frombuffer(bytes(self._ignored[first:end]), np.bool_),
        )
