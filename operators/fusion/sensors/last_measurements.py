"""Holds the latest measurement of each sensor of a filter."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.messages import Message, Odometry
from dataflow.operator import Remembered


class LastMeasurements(Remembered):
    """Keeps the last stamp and odometry of each sensor, by its name in the settings, and the streams that there are."""

    streams: set[str]
    """Names without the namespace."""
    stamps: dict[str, int]
    _odometry: dict[str, Odometry]

    def __init__(self) -> None:
        self.streams, self.stamps, self._odometry = set(), {}, {}

    def hear(self, streams: Iterable[str]) -> None:
        """Notes that these streams have messages."""
        self.streams |= {stream.partition("/")[2] for stream in streams}

    def follows(self, name: str, stamp: int) -> bool:
        """Returns whether a message comes after the sensor's last; then it is the last."""
        if stamp <= self.stamps.get(name, -1):
            return False
        self.stamps[name] = stamp
        return True

    def before(self, name: str, message: Message) -> Odometry | None:
        """Returns the sensor's odometry before this message, which takes its place if it is one."""
        before = self._odometry.get(name)
        if isinstance(message, Odometry):
            self._odometry[name] = message
        return before
