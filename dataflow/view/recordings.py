"""Feeds a recording to a viewer, as fast as the viewer draws."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from typing import Protocol

from dataflow.graph.model import Graph
from dataflow.graph.sections import PLACE_FRAMES
from dataflow.messages import Alarm, Message
from dataflow.recording import LogLine, Recorded, Recording, StreamInfo
from dataflow.recording.layout import RECORDING, logs_topic
from dataflow.records.figures import recorded_summaries
from dataflow.view.process import ViewerError
from dataflow.view.sink import ViewerSink

_PATIENCE = 30.0  # seconds without progress after which a viewer counts as stalled


class RecordedStreams(Protocol):
    """Streams of messages by name, of a recording or of a bag of another system."""

    streams: Mapping[str, StreamInfo]

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        """Messages with start ≤ stamp ≤ end (ns), merged by (stamp, stream); static streams first and whole."""


def as_alarm(line: LogLine, clock: int) -> Alarm:
    """A line of the log as the message that is drawn, at its event time or, where it has none, at `clock`."""
    return Alarm(stamp=line.stamp or clock, level=line.level, name=line.name, text=line.text)


def from_recording(
    recording: RecordedStreams,
    sink: ViewerSink,
    streams: Sequence[str] | None = None,
    start: int | None = None,
    end: int | None = None,
    *,
    graph: Graph | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Opens `sink` for the recorded `streams` (None: all that have a message type) and logs what they hold.

    Static streams come first and whole; of the others, messages with start ≤ stamp ≤ end (ns). `graph` decides what is
    drawn over what, and what is hidden. Frames are placed by what is recorded of them, whatever is shown. The run's log
    is shown too where all streams are, and its scores where there is a graph; a bag has neither. Waits for the
    viewer instead of dropping. `progress` is called with each stamp. Returns how many messages were handed over; the
    sink stays open. Raises `ViewerError` for a viewer that cannot be reached or takes nothing for 30 s,
    `RecordingError` for an unknown stream and for data that does not decode.
    """
    readable = {name: info.message_type for name, info in recording.streams.items() if info.message_type is not None}
    types = {name: type_ for name, type_ in readable.items() if streams is None or name in streams}
    others = {n: type_ for n, type_ in readable.items() if n not in types and type_.SCHEMA in PLACE_FRAMES}
    static = [name for name in (*types, *others) if recording.streams[name].static]
    lines: Sequence[tuple[int, LogLine]] = ()
    logs = ""
    if isinstance(recording, Recording) and types.keys() >= readable.keys():
        lines = [entry for entry in recording.logs() if (start or 0) <= entry[0] and (end is None or entry[0] <= end)]
        logs = logs_topic(recording.metadata.get(RECORDING, {}).get("namespace", ""))
    if lines:
        types[logs] = Alarm
    sink.open(types | others, graph, static, hidden=others)
    if graph is not None and isinstance(recording, Recording):
        judges = (name for name, node in graph.nodes.items() if not node.outputs)
        sink.scores(recorded_summaries(recording, judges))
    wanted = None if streams is None else [*streams, *others]
    count = 0
    for stream, message in _with_lines(recording.messages(wanted, start, end), logs, lines):
        dropped = sink.statistics().dropped
        count += sink.log(stream, message, wait=_PATIENCE)
        if sink.statistics().dropped > dropped:
            raise ViewerError(f"the viewer took nothing for {_PATIENCE:g} s; {count:,} messages were handed over")
        if progress is not None:
            progress(message.stamp)
    return count


def _with_lines(
    messages: Iterable[Recorded], logs: str, lines: Iterable[tuple[int, LogLine]]
) -> Iterator[tuple[str, Message]]:
    """The messages by stream, and each line of the log just before the first message with a later stamp."""
    waiting = deque(sorted(lines, key=itemgetter(0)))
    for recorded in messages:
        while waiting and waiting[0][0] < recorded.stamp:
            stamp, line = waiting.popleft()
            yield logs, as_alarm(line, stamp)
        yield recorded.stream, recorded.message
    for stamp, line in waiting:
        yield logs, as_alarm(line, stamp)
