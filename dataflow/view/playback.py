"""Feeds a recording to a viewer, as fast as the viewer draws."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

from dataflow.messages import Message
from dataflow.view.process import ViewerError
from dataflow.view.sink import ViewerSink

_PATIENCE = 30.0  # seconds without progress after which a viewer counts as stalled


class RecordedMessage(Protocol):
    """One message of a recording."""

    @property
    def stream(self) -> str: ...

    @property
    def message(self) -> Message: ...


class RecordingReader(Protocol):
    """A recording that yields its messages in stamp order, static streams first."""

    def messages(self) -> Iterator[RecordedMessage]: ...


def from_recording(
    recording: RecordingReader,
    sink: ViewerSink,
    streams: Iterable[str] | None = None,
    start: int | None = None,
    end: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Logs the recorded messages of `streams` (None: all) with start ≤ stamp ≤ end (ns) to an open sink; returns how many.

    Messages of the sink's static streams are logged whatever their stamp. Waits for the viewer instead of dropping;
    raises `ViewerError` when it takes nothing for 30 s. `progress` is called with each stamp.
    """
    chosen = None if streams is None else set(streams)
    count = 0
    for recorded in recording.messages():
        stamp = recorded.message.stamp
        if chosen is not None and recorded.stream not in chosen:
            continue
        if not sink.is_static(recorded.stream):
            if start is not None and stamp < start:
                continue
            if end is not None and stamp > end:
                break
        before = sink.statistics().dropped
        count += sink.log(recorded.stream, recorded.message, wait=_PATIENCE)
        if sink.statistics().dropped > before:
            raise ViewerError(f"the viewer took nothing for {_PATIENCE:g} s; {count:,} messages were handed over")
        if progress is not None:
            progress(stamp)
    return count
