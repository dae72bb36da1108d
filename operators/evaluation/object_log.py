"""The objects of many images in a few arrays: 25 bytes an object, so that a score may last for hours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D

_BLOCK = 2048
_OBJECT = np.dtype([("box", "<f4", 4), ("score", "<f4"), ("name", "<i4"), ("ignored", "?")])
_IMAGE = np.dtype([("stamp", "<i8"), ("end", "<i8"), ("size", "<i4", 2)])


@dataclass(frozen=True, eq=False)
class Objects:
    """Holds what scoring needs of an image: boxes (N, 4) in pixels, class names, scores, which objects are ignored."""

    size: NDArray[np.float64]
    boxes: NDArray[np.float64]
    labels: tuple[str, ...]
    scores: NDArray[np.float32]
    ignored: NDArray[np.bool_]


class _Rows:
    """Rows in blocks that never move: an array that grows would leave holes of all its sizes in the memory."""

    def __init__(self, kind: np.dtype[Any]) -> None:
        self._kind = kind
        self._blocks: list[NDArray[Any]] = []
        self.count = 0

    def append(self, rows: NDArray[Any]) -> None:
        done = 0
        while done < len(rows):
            at = self.count % _BLOCK
            if not at:
                self._blocks.append(np.empty(_BLOCK, self._kind))
            taken = min(_BLOCK - at, len(rows) - done)
            self._blocks[-1][at : at + taken] = rows[done : done + taken]
            self.count, done = self.count + taken, done + taken

    def between(self, first: int, end: int) -> NDArray[Any]:
        """The rows from `first` up to before `end`."""
        blocks = range(first // _BLOCK, -(-end // _BLOCK))
        parts = [self._blocks[k][max(first - k * _BLOCK, 0) : end - k * _BLOCK] for k in blocks]
        return np.concatenate(parts) if parts else np.empty(0, self._kind)


class ObjectLog:
    """Collects the objects of one stream's images in the order in which they come."""

    def __init__(self) -> None:
        self._images, self._objects = _Rows(_IMAGE), _Rows(_OBJECT)
        self._names: list[str] = []
        self._numbers: dict[str, int] = {}

    def __len__(self) -> int:
        return self._images.count

    @property
    def stamps(self) -> list[int]:
        """The stamp of each image."""
        stamps: list[int] = self._images.between(0, len(self))["stamp"].tolist()
        return stamps

    def add(self, message: Detections2D, ignored: NDArray[np.bool_] | None = None) -> None:
        """Takes the objects of one image; `ignored`: those that do not count, none if not given."""
        rows = np.zeros(message.count, _OBJECT)
        rows["box"], rows["score"] = message.boxes, message.scores
        rows["name"] = [self._number(name) for name in message.labels()]
        if ignored is not None:
            rows["ignored"] = ignored
        self._objects.append(rows)
        end = self._objects.count
        self._images.append(np.array([(message.stamp, end, (message.width, message.height))], _IMAGE))

    def _number(self, name: str) -> int:
        number = self._numbers.setdefault(name, len(self._names))
        if number == len(self._names):
            self._names.append(name)
        return number

    def image(self, index: int) -> Objects:
        """The objects of one image, by its place in `stamps`."""
        *before, image = self._images.between(max(index - 1, 0), index + 1)
        found = self._objects.between(int(before[0]["end"]) if before else 0, int(image["end"]))
        return Objects(
            image["size"].astype(np.float64),
            found["box"].astype(np.float64),
            tuple(self._names[number] for number in found["name"].tolist()),
            found["score"].copy(),
            found["ignored"].copy(),
        )
