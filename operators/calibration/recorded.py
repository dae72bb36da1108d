"""Views of a board in the recorded images of one camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import zip_longest

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.api.asof import asof
from dataflow.api.names import StreamNameError
from dataflow.api.recordings import RecordedStreams
from dataflow.api.stream import RecordedStream
from dataflow.messages import CameraInfo, CompressedImage, Image, Message
from operators.calibration import coverage
from operators.calibration.boards import Board, View
from operators.calibration.camera import BLURRED, CameraCalibration, Model, different, fit_camera, warnings_of

Along = Callable[[list[int], str], Iterable[int]]
"""Gives places one by one, with a display of how far it is under a name."""


@dataclass(frozen=True, eq=False, slots=True)
class BoardViews:
    """The images of a stream, of `size` (width, height), `looked` of all `there`, and their `views` of a board."""

    name: str
    frame: str
    board: Board
    size: tuple[int, int]
    looked: int
    views: tuple[View, ...]
    there: int = 0

    @property
    def blurred(self) -> int:
        """Views that are too blurred to be used."""
        return sum(view.blur > BLURRED for view in self.views)

    def fit(self, model: Model) -> CameraCalibration:
        """Returns the camera's calibration. Raises ValueError, with what the images showed."""
        try:
            return fit_camera(self.board, different(self.views, self.size[0]), self.frame, self.size, model)
        except ValueError as error:
            raise ValueError(
                f"{self.name}: {error} (a board in {len(self.views)} of {images_looked_at(self.looked, self.there)}, "
                f"{self.blurred} blurred, the others alike)"
            ) from error

    def covered(self, fitted: CameraCalibration) -> NDArray[np.int32]:
        """Returns the number of views (H, W) with the board at each pixel."""
        return coverage.counts(fitted.views, self.size)

    def warnings(self, fitted: CameraCalibration) -> list[str]:
        """Returns what makes the calibration poor, each with what would mend it."""
        found = warnings_of(fitted)
        if self.blurred > len(self.views) / 4:
            found.append(
                f"{self.blurred} of {len(self.views)} views are blurred and left out: move slowly, or expose shorter"
            )
        if lacking := coverage.unseen_parts(self.covered(fitted)):
            found.append(f"hardly any board was in these parts of the image: {', '.join(lacking)}")
        return found


def images_looked_at(looked: int, there: int) -> str:
    """Returns their number in words, with that of all where some were passed by."""
    passed = f" of {there} (--every 0 looks at all)" if looked < there else ""
    return f"{looked} image{'s' * (looked != 1)}{passed}"


def spaced(stamps: NDArray[np.int64], every: float) -> list[int]:
    """Returns places of messages at least `every` seconds apart."""
    found: list[int] = []
    for place, stamp in enumerate(stamps.tolist()):
        if not found or stamp - int(stamps[found[-1]]) >= round(every * 1e9):
            found.append(place)
    return found


def spaced_pairs(left: RecordedStream, right: RecordedStream, every: float, tolerance: int) -> list[list[int]]:
    """Returns places of images in two streams, those of a pair at most `tolerance` ns apart, at least `every` seconds
    from pair to pair. Raises ValueError where no two images are so near."""
    beside = asof(left.stamps, right.stamps, "nearest", tolerance)
    there = np.flatnonzero(beside >= 0)
    if not len(there):
        raise ValueError(
            f"no image of {left.info.name} lies within {tolerance / 1e6:g} ms of one of {right.info.name}: "
            "--tolerance takes more"
        )
    chosen = there[spaced(left.stamps[there], every)]
    return [chosen.tolist(), np.unique(beside[chosen]).tolist()]


def look(board: Board, stream: RecordedStream, places: list[int], along: Along) -> BoardViews:
    """Returns what images of a stream, at `places` in it, show of a board.

    Raises ValueError where images differ in size, none can be read, or none shows the board.
    """
    name, frame, size, looked, views = stream.info.name, "", (0, 0), 0, list[View]()
    for place in along(places, name):
        message = stream[place]
        grey = _grey(message)
        if grey is None:
            continue
        now = (grey.shape[1], grey.shape[0])
        if looked and now != size:
            raise ValueError(f"{name} has images of {size[0]}x{size[1]} and of {now[0]}x{now[1]} pixels: one is needed")
        size, frame, looked = now, str(getattr(message, "frame", "")), looked + 1
        if (view := board.find(message.stamp, grey)) is not None:
            views.append(view)
    if not looked:
        raise ValueError(f"{name} has no image that can be read")
    if not views:
        raise ValueError(
            f"{name}: no board in {images_looked_at(looked, len(stream))}: are its counts right ({board})?"
        )
    return BoardViews(name, frame, board, size, looked, tuple(views), len(stream))


def own_frames(left: BoardViews, right: BoardViews) -> tuple[BoardViews, BoardViews]:
    """Returns both cameras with different frames: where they have the same, the parts of their streams' names
    that differ, such as `left` and `right`."""
    if left.frame != right.frame:
        return left, right
    parts = zip_longest(left.name.split("/"), right.name.split("/"), fillvalue="")
    apart = [pair for pair in parts if pair[0] != pair[1]]
    one, other = ("/".join(filter(None, (pair[k] for pair in apart))) for k in (0, 1))
    return replace(left, frame=one or left.name), replace(right, frame=other or right.name)


def stream_of(
    streams: RecordedStreams, name: str | None, types: tuple[type[Message], ...], option: str, what: str
) -> RecordedStream:
    """Returns the stream of a name, or the only one of its types below that name or, without one, of all.

    Raises ValueError, StreamNameError.
    """
    there = [each for each in streams if streams[each].info.message_type in types]
    if name is None:
        if len(there) != 1:
            listed = ", ".join(there) or "none"
            raise ValueError(f"{streams.path} has {len(there)} streams of {what} ({listed}): {option} names one")
        return streams[there[0]]
    try:
        stream = streams[name]
    except StreamNameError:
        below = [each for each in there if f"/{name.strip('/')}/" in f"/{each}/"]
        if len(below) != 1:
            raise
        stream = streams[below[0]]
    if stream.info.name not in there:
        raise ValueError(f"{stream.info.name} holds no {what}; there are {', '.join(there) or 'none'}")
    return stream


def images_of(streams: RecordedStreams, name: str | None, option: str) -> RecordedStream:
    """Returns a stream of images. Raises ValueError, StreamNameError."""
    return stream_of(streams, name, (Image, CompressedImage), option, "images")


def intrinsics_of(streams: RecordedStreams, frame: str) -> CameraInfo:
    """Returns the recorded calibration of a frame. Raises ValueError where there is none."""
    for name in streams:
        stream = streams[name]
        if stream.info.message_type is CameraInfo and len(stream):
            info = stream[0]
            if isinstance(info, CameraInfo) and info.frame == frame:
                return info
    raise ValueError(f"{streams.path} has no calibration of the frame {frame!r}: --camera FILE gives it")


def _grey(message: Message) -> NDArray[np.uint8] | None:
    if isinstance(message, CompressedImage):
        read = cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE)
        return None if read is None else np.asarray(read, np.uint8)
    assert isinstance(message, Image)
    grey = message.data if message.data.ndim == 2 else cv2.cvtColor(message.data, cv2.COLOR_RGB2GRAY)
    return np.ascontiguousarray(grey, np.uint8)
