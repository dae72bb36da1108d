"""The turning of the robot, as each kind of stream shows it: gyroscope, poses, wheels, images.

Only the size of the rate is taken, which does not depend on how a sensor is mounted, and its scale does not matter: an
image moves by so many pixels, wheels by so many counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from dataflow.messages import CompressedImage, Image, Imu, Message, Odometry, Pose, WheelTicks

F64 = npt.NDArray[np.float64]
T = TypeVar("T")

WIDTH: Final = 160
"""Columns to which images are reduced."""


@dataclass(frozen=True, slots=True)
class Turning:
    """Mean rates over intervals: `begins` and `ends` (s after an origin), `rates` (≥ 0, of any scale).

    A gyroscope's samples are moments: their intervals reach from one to the next.
    """

    begins: F64
    ends: F64
    rates: F64

    @property
    def period(self) -> float:
        """The median interval, s."""
        return float(np.median(self.ends - self.begins)) if len(self.ends) else 0.0


def turning_of(messages: Iterable[Message], message_type: str, origin: int) -> Turning | None:
    """The turning that a stream shows, from `origin` (ns) on; None where its type shows none or it is too short."""
    read = READERS.get(message_type)
    rows = [] if read is None else [row for row in read(messages) if row[1] > row[0] and np.isfinite(row[2])]
    if len(rows) < 2:
        return None
    begins, ends, rates = zip(*rows, strict=True)
    seconds = [np.array([stamp - origin for stamp in which], np.float64) * 1e-9 for which in (begins, ends)]
    return Turning(seconds[0], seconds[1], np.array(rates))


Reading = Iterator[tuple[int, int, float]]


def _gyro(messages: Iterable[Message]) -> Reading:
    before: tuple[int, float] | None = None
    for message in messages:
        assert isinstance(message, Imu)
        rate = float(np.linalg.norm(message.angular_velocity))
        if before is not None:
            yield before[0], message.stamp, (before[1] + rate) / 2
        before = message.stamp, rate


def _changes(states: Iterable[tuple[int, T]], change: Callable[[T, T], float]) -> Reading:
    """The mean rate from one (stamp, state) to the next."""
    for (begin, before), (end, after) in pairwise(states):
        if end > begin:
            yield begin, end, change(before, after) / ((end - begin) * 1e-9)


def _poses(messages: Iterable[Message]) -> Reading:
    turns = ((m.stamp, m.orientation) for m in messages if isinstance(m, (Pose, Odometry)))
    return _changes(turns, lambda a, b: float(2 * np.arccos(min(abs(float(b @ a)), 1.0))))


def _wheels(messages: Iterable[Message]) -> Reading:
    ticks = ((m.stamp, _across(m)) for m in messages if isinstance(m, WheelTicks))
    return _changes(ticks, lambda a, b: abs(b - a))


def _across(message: WheelTicks) -> float:
    sides = [[i for i, name in enumerate(message.names) if side in name.lower()] for side in ("left", "right")]
    left, right = (which or [k] for which, k in zip(sides, (0, len(message.names) - 1), strict=True))
    return float(message.ticks[right].mean() - message.ticks[left].mean())


def _images(messages: Iterable[Message]) -> Reading:
    import cv2

    @cache
    def window(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
        return cv2.createHanningWindow(shape[::-1], cv2.CV_32F)  # type: ignore[return-value]

    def moved(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> float:
        if a.shape != b.shape:
            return np.nan
        (x, y), _ = cv2.phaseCorrelate(a, b, window(a.shape))
        return float(np.hypot(x, y))

    return _changes(((m.stamp, pixels) for m in messages if (pixels := _grey(m)) is not None), moved)


def _grey(message: Message) -> npt.NDArray[np.float32] | None:
    import cv2

    if isinstance(message, CompressedImage):
        pixels = cv2.imdecode(message.data, cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            return None
    else:
        assert isinstance(message, Image)
        pixels = message.data if message.data.ndim == 2 else message.data[:, :, 1]
    rows = max(round(pixels.shape[0] * WIDTH / pixels.shape[1]), 8)
    return cv2.resize(pixels, (WIDTH, rows), interpolation=cv2.INTER_AREA).astype(np.float32)


READERS: Final[dict[str, Callable[[Iterable[Message]], Reading]]] = {
    "Imu": _gyro,
    "Pose": _poses,
    "Odometry": _poses,
    "WheelTicks": _wheels,
    "Image": _images,
    "CompressedImage": _images,
}
