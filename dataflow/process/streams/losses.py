"""Decides what becomes of messages that were lost on their way to a process; chosen once, by the kind of run."""

from __future__ import annotations

from dataflow.process.channel import Channel
from dataflow.sync import StreamOrderError


class StreamDamaged(RuntimeError):
    """Messages of a stream were lost where none may be."""


class LosslessPolicy:
    """Nothing may be lost: going on would mean computing something else than was sent."""

    def __init__(self, label: str) -> None:
        """`label`: of the process."""
        self._label = label

    def lost(self, stream: str, first: int, following: int) -> None:
        """Messages from number `first` to before `following` were lost: to a link that broke, or before this process
        was there. Raises `StreamDamaged`."""
        raise StreamDamaged(
            f"stream {stream!r} lost messages on its way to process {self._label!r}: "
            f"number {first} was due, {following} came"
        )

    def damaged(self, stream: str, how: str) -> None:
        """A message had to be refused that may well be the stream's own. Raises `StreamDamaged`."""
        raise StreamDamaged(f"stream {stream!r} on its way to process {self._label!r} {how}")

    def contradicted(self, error: StreamOrderError) -> None:
        """An envelope contradicts what an operator has seen of its stream. Raises the error."""
        raise error


class LossReportingPolicy(LosslessPolicy):
    """A live run goes on: the supervisor is notified, and what does not fit is refused and counted."""

    def __init__(self, label: str, channel: Channel) -> None:
        super().__init__(label)
        self._channel = channel

    def lost(self, stream: str, first: int, following: int) -> None:
        """Reports to the supervisor."""
        self._channel.send("gap", stream=stream, first=first, following=following)

    def damaged(self, stream: str, how: str) -> None:
        """Nothing more: the inlet refuses it."""

    def contradicted(self, error: StreamOrderError) -> None:
        """Nothing more: the inlet refuses it."""


def losses_of(label: str, channel: Channel, *, live: bool) -> LosslessPolicy:
    """Returns what a process of a run does."""
    return LossReportingPolicy(label, channel) if live else LosslessPolicy(label)
