"""The turning of the robot, as each kind of stream shows it: gyroscope, poses, wheels, images.

Only the size of the rate is taken, which does not depend on how a sensor is mounted, and its scale does not matter: an
image moves by so many pixels, wheels by so many counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from dataflow.messages import CompressedImage, Image, Imu, Message, Odometry, Pose, WheelTicks

F64 = npt.NDArray[np.float64]

WIDTH: Final = 160
"""Columns to which images are reduced."""


@dataclass(frozen=True, slots=True)
class Turning:
    """Mean rates over intervals: `begins` and `ends` (s after `origin`, ns), `rates` (≥ 0, of any scale).

    A gyroscope's samples are moments: their intervals reach from one to the next.
    """

    origin: int
    begins: F64
    ends: F64
    rates: F64

    @property
    def period(self) -> float:
        """The median interval, s."""
        return float(np.median(self.ends - self.begins)) if len(self.ends) else 0.0


def turning_of(messages: Iterable[Message], message_type: str, origin: int) -> Turning | None:
    """The turning that a stream shows; None where its type shows none or it is too short."""
    read = READERS.get(message_type)
    if read is None:
        return None
    stamps: list[int] = []
    rates: list[float] = []
    begins: list[int] = []
    for begin, end, rate in read(messages):
        if end > begin and np.isfinite(rate):
            begins.append(begin)
            stamps.append(end)
            rates.append(rate)
    if len(rates) < 2:
        return None
    seconds = [np.array([stamp - origin for stamp in which], np.float64) * 1e-9 for which in (begins, stamps)]
    return Turning(origin, seconds[0], seconds[1], np.array(rates))


Reading = Iterator[tuple[int, int, float]]


def _gyro(messages: Iterable[Message]) -> Reading:
    before: tuple[int, float] | None = None
    for message in messages:
        assert isinstance(message, Imu)
        rate = float(np.linalg.norm(message.angular_velocity))
        if before is not None:
            yield before[0], message.stamp, (before[1] + rate) / 2
        before = message.stamp, rate


def _poses(messages: Iterable[Message]) -> Reading:
    before: tuple[int, F64] | None = None
    for message in messages:
        assert isinstance(message, (Pose, Odometry))
        if before is not None and message.stamp > before[0]:
            inner = min(abs(float(message.orientation @ before[1])), 1.0)
            yield before[0], message.stamp, 2 * np.arccos(inner) / ((message.stamp - before[0]) * 1e-9)
        before = message.stamp, message.orientation


def _wheels(messages: Iterable[Message]) -> Reading:
    before: tuple[int, float] | None = None
    for message in messages:
        assert isinstance(message, WheelTicks)
        sides = [[i for i, name in enumerate(message.names) if side in name.lower()] for side in ("left", "right")]
        left, right = (which or [k] for which, k in zip(sides, (0, len(message.names) - 1), strict=True))
        across = float(message.ticks[right].mean() - message.ticks[left].mean())
        if before is not None and message.stamp > before[0]:
            yield before[0], message.stamp, abs(across - before[1]) / ((message.stamp - before[0]) * 1e-9)
        before = message.stamp, across


def _images(messages: Iterable[Message]) -> Reading:
    import cv2

    before: tuple[int, npt.NDArray[np.float32]] | None = None
    window: npt.NDArray[np.float32] | None = None
    for message in messages:
        pixels = _grey(message)
        if pixels is None:
            continue
        if window is None or window.shape != pixels.shape:
            window, before = cv2.createHanningWindow(pixels.shape[::-1], cv2.CV_32F), None  # type: ignore[assignment]
        if before is not None and message.stamp > before[0]:
            (x, y), _ = cv2.phaseCorrelate(before[1], pixels, window)
            yield before[0], message.stamp, float(np.hypot(x, y)) / ((message.stamp - before[0]) * 1e-9)
        before = message.stamp, pixels


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
