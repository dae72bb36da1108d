"""Feeds a recording to a viewer, as fast as the viewer draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dataflow.graph.model import Graph
from dataflow.messages import Message
from dataflow.recording import Recording
from dataflow.view.process import ViewerError
from dataflow.view.sink import ViewerSink

_PATIENCE = 30.0  # seconds without progress after which a viewer counts as stalled


def from_recording(
    recording: Recording,
    sink: ViewerSink,
    streams: Sequence[str] | None = None,
    start: int | None = None,
    end: int | None = None,
    *,
    graph: Graph | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Opens `sink` for the recorded `streams` (None: all that have a message type) and logs what they hold.

    Static streams come first and whole; of the others, messages with start ≤ stamp ≤ end (ns). `graph` says what is
    drawn over what, and what is hidden. Waits for the viewer instead of dropping. `progress` is called with each stamp.
    Returns how many messages were handed over; the sink stays open. Raises `ViewerError` for a viewer that cannot be
    reached or takes nothing for 30 s, `RecordingError` for an unknown stream and for data that does not decode.
    """
    types: dict[str, type[Message]] = {
        name: info.message_type
        for name, info in recording.streams.items()
        if info.message_type is not None and (streams is None or name in streams)
    }
    sink.open(types, graph, [name for name in types if recording.streams[name].static])
    count = 0
    for recorded in recording.messages(streams, start, end):
        dropped = sink.statistics().dropped
        count += sink.log(recorded.stream, recorded.message, wait=_PATIENCE)
        if sink.statistics().dropped > dropped:
            raise ViewerError(f"the viewer took nothing for {_PATIENCE:g} s; {count:,} messages were handed over")
        if progress is not None:
            progress(recorded.stamp)
    return count
