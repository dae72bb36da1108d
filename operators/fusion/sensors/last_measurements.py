"""Holds the latest measurement of each sensor of a filter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dataflow.messages import Message, Odometry


class LastMeasurements:
    """Keeps the last stamp and odometry of each sensor, by its name in the settings, and the streams that there are."""

    def __init__(self) -> None:
        self.streams: set[str] = set()
        """Names without the namespace."""
        self.stamps: dict[str, int] = {}
        self._odometry: dict[str, Odometry] = {}

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

    def odometry_state(self) -> dict[str, list[Any]]:
        """The last odometry of each sensor as plain values."""
        return {n: [m.stamp, m.frame, m.child_frame, m.position, m.orientation] for n, m in self._odometry.items()}

    def restore(self, streams: Iterable[str], stamps: Mapping[str, int], odometry: Mapping[str, Iterable[Any]]) -> None:
        """Takes up where a snapshot was."""
        self.streams = set(streams)
        self.stamps = {name: int(stamp) for name, stamp in stamps.items()}
        self._odometry = {
            name: Odometry(stamp=int(stamp), frame=frame, child_frame=child, position=p, orientation=q)
            for name, (stamp, frame, child, p, q) in odometry.items()
        }
