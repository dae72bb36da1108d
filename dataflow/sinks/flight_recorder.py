"""The flight recorder: the last seconds of a run in a ring of files; what a trigger asks for is kept.

Each file of the ring is a recording of some seconds, with the newest message of every stream in front. Records of
operators in a deleted file that still matter (their parameters, how often they were set up) are folded into a few.
"""

from __future__ import annotations

import shutil
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dataflow.editing.part import Part
from dataflow.graph.model import Graph
from dataflow.graph.sections import Flight
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message
from dataflow.process.awake_clock import AwakeClock
from dataflow.recording import LogLine, RecordingError
from dataflow.recording.parts import Storage
from dataflow.records.cuts import OrphanedMessage
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.sinks.flight_files import FlightFiles, Segment
from dataflow.sinks.outage import Outage, RecordingLosses
from dataflow.sinks.recorder import GOES_ON, RecorderSink
from dataflow.sinks.sink import StreamSink
from dataflow.sinks.triggers import Triggers
from dataflow.sync.stamps import format_stamp

PARTS = 6
"""Files into which the time to keep is divided."""
MOST_REASONS = 100
"""Triggers that one recording names."""
RECORDS_WITHIN = 30.0
"""Seconds after the end of a span for which it waits, at most, for the firing records of its messages."""
SHORTEST = 1_000_000_000
"""Event time of a file, at least (ns)."""


@dataclass(slots=True)
class PendingSpan:
    """A span that is to be kept: from `start` until the clock is at `due`."""

    start: int
    due: int
    reasons: list[dict[str, Any]] = field(default_factory=list)
    over: float | None = None
    """Time (s, of a clock that goes on while the recorder runs) at which it was seen to be over; None until then."""


class FlightSink(StreamSink):
    """Takes everything, keeps little. Kept files are joined on a separate thread, so that nothing waits for it."""

    def __init__(self, folder: Path, graph: Graph, streams: list[str], options: Mapping[str, Any]) -> None:
        flight = graph.record.flight
        assert flight is not None
        self.flight: Flight = flight
        self.folder, self.graph, self._streams, self._options = folder, graph, streams, options
        self._ring = folder / f".{options['label']}"
        self._storage: Storage = options["storage"]
        shutil.rmtree(self._ring, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
        self._ring.mkdir(0o700)
        self.length = max(flight.keep // PARTS, SHORTEST)
        self.slack = 2 * (graph.record.snapshots if isinstance(graph.record.snapshots, int) else 0) + 2 * self.length
        """Returns how much more than what is to be kept is there: from a state of every operator on."""
        self._awake = AwakeClock()
        self._clock = 0
        self._first: int | None = None
        self._newest: dict[str, tuple[Message, int, int]] = {}
        self._recorded: dict[str, int] = {}
        """The last stamp in each operator's firing records."""
        self._forgotten = False
        self._work = FlightFiles(graph, self._storage.mode)
        self._segments: deque[Segment] = deque()
        self._made = 0
        self._begun = 0
        self._triggers = Triggers(flight.when)
        self._wanted: PendingSpan | None = None
        self._kept: list[dict[str, Any]] = []
        self._refused = 0
        self._said_full = False
        self.messages = 0
        self._outage = Outage(folder)
        self.lost = RecordingLosses()
        self._given: Counter[str] = Counter()
        self._sink: RecorderSink | None = self._open()

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        """Takes a message; begins the next file, and keeps what was asked for, when it is time to."""
        if not self.graph.streams[stream].static:
            self._clock = max(self._clock, message.stamp)
            if self._first is None:
                self._first = message.stamp
            if self._wanted is not None and self._is_over(self._wanted):
                self._keep(self._wanted)
            elif self._clock - self._begun >= self.length:
                self._rotate()
        self._given[stream] += 1
        self._store(lambda sink: sink.message(stream, message, seq, incarnation))
        self._newest[stream] = (message, seq, incarnation)
        self.messages += 1
        for reason in self._triggers.message(stream, message):
            self._trigger(reason, message.stamp)

    def firings(self, operator: str, records: Sequence[FiringRecord], payload: bytes) -> None:
        made = (message.stamp for record in records for message in record.outputs if message is not None)
        self._recorded[operator] = max((records[-1].stamp, *made))
        calls = sum(record.kind in CALLS for record in records)
        if self._sink is None:
            self.lost.firings += calls
        self._store(lambda sink: sink.firings(operator, records[-1].stamp, payload, calls=calls))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._store(lambda sink: sink.end(stream, final_stamp, reason))

    def event(self, name: str, stamp: int, data: Mapping[str, Any]) -> None:
        """Takes an event: a restart, or a request to keep the history."""
        self._store(lambda sink: sink.event(name, stamp, data))
        for reason in self._triggers.event(name, data):
            self._trigger(reason, stamp)

    def diagnostics(self, message: Diagnostics) -> None:
        self._store(lambda sink: sink.diagnostics(message))
        for reason in self._triggers.diagnostics(message):
            self._trigger(reason, message.stamp)

    def log(self, line: LogLine) -> None:
        self._store(lambda sink: sink.log(line))

    def flush(self) -> None:
        """Hands everything to the operating system, about once a second; a disk that had refused is tried again."""
        self._awake()
        self._store(RecorderSink.flush)
        if self._sink is None and self._outage.over():
            self._begin()
            if self._sink is not None:
                self.lost.spans[-1] = self.lost.spans[-1][0], self._clock
                print("flight recorder: goes on", flush=True)

    def close(self, outcome: str) -> Mapping[str, Any]:
        """Keeps what is still asked for; a run that failed asks for its end, where it was to."""
        for reason in self._triggers.outcome(outcome):
            self._trigger(reason, self._clock)
        if self._wanted is not None:
            self._keep(self._wanted, outcome=outcome)
        else:
            self._store(lambda sink: sink.close(outcome))
        self._lose()
        self._work.finish()
        shutil.rmtree(self._ring, ignore_errors=True)
        facts = {
            "path": str(self.folder),
            "messages": sum(one.get("messages", 0) for one in self._kept),
            "bytes": sum(one["bytes"] for one in self._kept),
            "kept": self._kept,
            "not_kept": self._refused,
        }
        return {**facts, "lost": self.lost.as_json()} if self.lost.any else facts

    # Ring

    @property
    def ring_bytes(self) -> int:
        """Bytes of the ring's files."""
        return sum(segment.path.stat().st_size for segment in self._segments)

    def _open(self) -> RecorderSink:
        """Begins the next file, with the newest message of every stream in front."""
        path = self._ring / f"{self._made:06}.mcap"
        self._made += 1
        sink, held = None, dict[str, list[OrphanedMessage]]()
        try:
            sink = RecorderSink(path, self.graph, self._streams, self._options)
            for stream, (message, seq, incarnation) in sorted(self._newest.items()):
                sink.message(stream, message, seq, incarnation)
                one = OrphanedMessage(stream, incarnation, seq, message.stamp, message.digest())
                held.setdefault(self.graph.streams[stream].node, []).append(one)
        except RecordingError:
            if sink is not None:
                with suppress(RecordingError):  # the refusal once more; the file is closed
                    sink.writer.close()
            path.unlink(missing_ok=True)
            raise
        self.lost.messages += self._given  # while there was no file
        self._given = Counter(self._newest.keys())
        self._begun = self._clock
        self._segments.append(Segment(path, self._clock if self._newest else None, held))
        return sink

    def _rotate(self) -> None:
        if self._sink is not None:
            self._close_file(GOES_ON)
            if not self._is_stopped:
                self._begin()
        self._forget()

    def _close_file(self, outcome: str) -> None:
        self._store(lambda sink: sink.close(outcome))
        self._lose()

    def _begin(self) -> None:
        try:
            self._sink = self._open()
        except RecordingError as error:
            self._stop(error)

    # A disk that refuses

    def _store(self, act: Callable[[RecorderSink], object]) -> None:
        """Stores something in the current file, if there is one."""
        if self._sink is None:
            return
        try:
            act(self._sink)
        except RecordingError as error:
            if self._sink.writer.failed or self._storage.on_failure != "go_on":
                self._stop(error)
            elif self.lost.because(str(error)):
                print(f"flight recorder: not recorded: {error}", flush=True)

    def _stop(self, error: RecordingError) -> None:
        """Nothing is recorded from here on until the disk takes something again, or the run ends."""
        if self._storage.on_failure != "go_on":
            raise error
        if self._sink is not None:
            with suppress(RecordingError):  # the refusal once more; the file is closed
                self._sink.writer.close()
            self.lost.firings += self._sink.unsaved_calls
        self._lose()
        self._outage.begin()
        self.lost.because(str(error))
        if not self.lost.spans or self.lost.spans[-1][1] is not None:
            self.lost.spans.append((self._clock, None))
            print(f"flight recorder: stops, the run goes on: {error}", flush=True)

    @property
    def _is_stopped(self) -> bool:
        return bool(self.lost.spans) and self.lost.spans[-1][1] is None

    def _lose(self) -> None:
        """Counts what was given and is not in the current file, which is closed."""
        if self._sink is not None:
            self._given -= Counter({stream: self._sink.writer.saved(stream) for stream in self._streams})
            self._sink = None
        self.lost.messages += self._given
        self._given.clear()

    def _forget(self) -> None:
        """Deletes the files that can no longer be requested."""
        start = self._clock - self.flight.keep
        if self._wanted is not None:
            start = min(start, self._wanted.start)
        while len(self._segments) > 2:
            if (self._segments[1].begin or 0) > start - self.slack and not self._is_full():
                return
            self._forgotten = True
            self._work.forget(self._segments.popleft())

    def _is_full(self) -> bool:
        """Returns whether the ring exceeds its size limit; prints a warning the first time."""
        most = self.flight.disk
        if most is None or self.ring_bytes <= most:
            return False
        if not self._said_full:
            self._said_full = True
            print(f"flight recorder: {most} bytes hold less than the time it is to keep", flush=True)
        return True

    # Keeping

    def _is_over(self, wanted: PendingSpan) -> bool:
        """Returns whether a span is over, and the firing records of it, some of every operator, have had the time to
        come."""
        if self._clock <= wanted.due:
            return False
        now = self._awake()
        wanted.over = now if wanted.over is None else wanted.over
        waited = now - wanted.over
        behind = not self.graph.nodes.keys() <= self._recorded.keys() or any(
            self._recorded.get(self.graph.streams[stream].node, 0) < min(message.stamp, wanted.due)
            for stream, (message, _, _) in self._newest.items()
        )
        return bool(waited >= (RECORDS_WITHIN if behind else self._options["settle"]))

    def _trigger(self, reason: dict[str, Any], stamp: int) -> None:
        """Asks to save the history before now and the messages after it; what is asked for meanwhile becomes one.

        Now is the newest stamp that came, not `stamp`: a run that is paused, or slower than the clock, is behind it.
        """
        reason = {**reason, "stamp": stamp}
        if self._wanted is None and len(self._kept) >= self.flight.files:
            self._refused += 1
            return
        if self._wanted is None:
            self._wanted = PendingSpan(self._clock - self.flight.keep, self._clock + self.flight.after)
        elif self._clock + self.flight.after - self._wanted.start <= 2 * (self.flight.keep + self.flight.after):
            self._wanted.due = max(self._wanted.due, self._clock + self.flight.after)
        if len(self._wanted.reasons) < MOST_REASONS:
            self._wanted.reasons.append(reason)

    def _keep(self, wanted: PendingSpan, outcome: str = "") -> None:
        """Closes the current file and joins what is wanted of all of them."""
        self._wanted = None
        if self._sink is not None:
            self._close_file(outcome or GOES_ON)
        segments = list(self._segments)
        if not outcome and not self._is_stopped:
            self._begin()
        whole_beginning = not self._forgotten and (self._first or 0) >= wanted.start
        to_the_end = outcome and self._clock <= wanted.due
        part = Part(None if whole_beginning else wanted.start, None if to_the_end else wanted.due)
        name = f"{self.graph.name}_{format_stamp(wanted.reasons[0]['stamp']).replace(':', '').partition('.')[0]}"
        out = self._free(name)
        one: dict[str, Any] = {"path": str(out), "reasons": wanted.reasons, "bytes": 0}
        self._kept.append(one)
        self._work.join(segments, part, out, one)

    def _free(self, name: str) -> Path:
        """A file name that is free, and that nothing kept before has."""
        taken = {one["path"] for one in self._kept}
        numbered = (self.folder / f"{name}{f'_{k}' if k else ''}.mcap" for k in range(10_000))
        return next(path for path in numbered if not path.exists() and str(path) not in taken)
