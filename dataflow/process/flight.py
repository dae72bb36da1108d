"""The flight recorder: the last seconds of a run in a ring of files; what a trigger asks for is kept.

Each file of the ring is a recording of some seconds, with the newest message of every stream in front. What a deleted
file said of operators that still matters (their parameters, how often they were set up) is folded into a few records.
"""

from __future__ import annotations

import json
import queue
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from dataflow.editing.part import Part
from dataflow.editing.rolling import keep_span
from dataflow.editing.spans import folded
from dataflow.graph.model import Graph
from dataflow.graph.sections import Flight
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message
from dataflow.process.recorder import RecorderSink
from dataflow.process.triggers import Triggers
from dataflow.recording import LogLine, Recording, RecordingError
from dataflow.recording.layout import FLIGHT
from dataflow.records.cuts import Held, cut_record
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.sync.stamps import format_stamp

PARTS = 6
"""Files into which the time to keep is divided."""
MOST_REASONS = 100
"""Triggers that one recording names."""
MOST_WAITING = 8
"""Files that wait to be deleted, and spans that wait to be joined: then the recorder waits, so that the disk is
bounded."""
SHORTEST = 1_000_000_000
"""Event time of a file, at least (ns)."""


@dataclass(slots=True)
class Segment:
    """One file of the ring. `begin`: the stamp at which it was begun (None: before the first message); `held`: the
    messages of files before it that stand in front, by operator."""

    path: Path
    begin: int | None
    held: Mapping[str, list[Held]]


@dataclass(slots=True)
class Wanted:
    """A span that is to be kept: from `start` until the clock is at `due`."""

    start: int
    due: int
    reasons: list[dict[str, Any]] = field(default_factory=list)
    over: float = 0.0
    """Time (s, steady) at which it was seen to be over; 0 until then."""


class FlightSink:
    """Takes everything, keeps little. What is kept is joined on a thread of its own, so that nothing waits for it."""

    def __init__(self, folder: Path, graph: Graph, streams: list[str], options: Mapping[str, Any]) -> None:
        flight = graph.record.flight
        assert flight is not None
        self.flight: Flight = flight
        self.folder, self.graph, self._streams, self._options = folder, graph, streams, options
        self._ring = folder / f".{options['label']}"
        shutil.rmtree(self._ring, ignore_errors=True)
        self._ring.mkdir(parents=True)
        self.length = max(flight.keep // PARTS, SHORTEST)
        self.slack = 2 * (graph.record.snapshots or 0) + 2 * self.length
        """Tells how much more than what is to be kept is there: from a state of every operator on."""
        self._clock = 0
        self._first: int | None = None
        self._newest: dict[str, tuple[Message, int, int]] = {}
        self._forgotten = False
        self._work = _Work(graph)
        self._segments: deque[Segment] = deque()
        self._made = 0
        self._begun = 0
        self._triggers = Triggers(flight.when)
        self._wanted: Wanted | None = None
        self._kept: list[dict[str, Any]] = []
        self._refused = 0
        self._said_full = False
        self.messages = 0
        self._sink = self._open()

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
        self._sink.message(stream, message, seq, incarnation)
        self._newest[stream] = (message, seq, incarnation)
        self.messages += 1
        for reason in self._triggers.message(stream, message):
            self._trigger(reason, message.stamp)

    def firings(self, operator: str, stamp: int, payload: bytes) -> None:
        self._sink.firings(operator, stamp, payload)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._sink.end(stream, final_stamp, reason)

    def event(self, name: str, stamp: int, data: Mapping[str, Any]) -> None:
        """Takes an event: a restart, or somebody who asks to keep what was."""
        self._sink.event(name, stamp, data)
        for reason in self._triggers.event(name, data):
            self._trigger(reason, stamp)

    def diagnostics(self, message: Diagnostics) -> None:
        self._sink.diagnostics(message)
        for reason in self._triggers.diagnostics(message):
            self._trigger(reason, message.stamp)

    def log(self, line: LogLine) -> None:
        self._sink.log(line)

    def summaries(self, found: Mapping[str, Mapping[str, Any]]) -> None:
        """Sums of operators are told by their finish records."""

    def flush(self) -> None:
        self._sink.flush()

    def close(self, outcome: str) -> Mapping[str, Any]:
        """Keeps what is still asked for; a run that failed asks for its end, where it was to."""
        for reason in self._triggers.outcome(outcome):
            self._trigger(reason, self._clock)
        if self._wanted is not None:
            self._keep(self._wanted, outcome=outcome)
        else:
            self._sink.close(outcome)
        self._work.finish()
        shutil.rmtree(self._ring, ignore_errors=True)
        return {
            "path": str(self.folder),
            "messages": self.messages,
            "bytes": sum(one["bytes"] for one in self._kept),
            "kept": self._kept,
            "not_kept": self._refused,
        }

    # Ring

    @property
    def ring_bytes(self) -> int:
        """Bytes of the ring's files."""
        return sum(segment.path.stat().st_size for segment in self._segments)

    def _open(self) -> RecorderSink:
        """Begins the next file, with the newest message of every stream in front."""
        path = self._ring / f"{self._made:06}.mcap"
        self._made += 1
        sink = RecorderSink(path, self.graph, self._streams, self._options)
        held: dict[str, list[Held]] = {}
        for stream, (message, seq, incarnation) in sorted(self._newest.items()):
            sink.message(stream, message, seq, incarnation)
            one = Held(stream, incarnation, seq, message.stamp, message.digest())
            held.setdefault(self.graph.streams[stream].node, []).append(one)
        self._begun = self._clock
        self._segments.append(Segment(path, self._clock if self._newest else None, held))
        return sink

    def _rotate(self, outcome: str = "goes on") -> None:
        self._sink.close(outcome)
        self._sink = self._open()
        self._forget()

    def _forget(self) -> None:
        """Deletes the files that nobody can ask for any more."""
        start = self._clock - self.flight.keep
        if self._wanted is not None:
            start = min(start, self._wanted.start)
        while len(self._segments) > 2:
            if (self._segments[1].begin or 0) > start - self.slack and not self._is_full():
                return
            self._forgotten = True
            self._work.forget(self._segments.popleft())

    def _is_full(self) -> bool:
        """Tells whether the ring takes more of the disk than it may; says so once."""
        most = self.flight.disk
        if most is None or self.ring_bytes <= most:
            return False
        if not self._said_full:
            self._said_full = True
            print(f"flight recorder: {most} bytes hold less than the time it is to keep", flush=True)
        return True

    # Keeping

    def _is_over(self, wanted: Wanted) -> bool:
        """Tells whether a span is over, and the firing records of it have had the time to come."""
        if self._clock <= wanted.due:
            return False
        wanted.over = wanted.over or time.monotonic()
        return bool(time.monotonic() - wanted.over >= self._options["settle"])

    def _trigger(self, reason: dict[str, Any], stamp: int) -> None:
        """Asks to keep what was before and will be after `stamp`; what is asked for meanwhile becomes one."""
        reason = {**reason, "stamp": stamp}
        if self._wanted is None and len(self._kept) >= self.flight.files:
            self._refused += 1
            return
        if self._wanted is None:
            self._wanted = Wanted(max(stamp, self._clock) - self.flight.keep, self._clock + self.flight.after)
        elif self._clock + self.flight.after - self._wanted.start <= 2 * (self.flight.keep + self.flight.after):
            self._wanted.due = max(self._wanted.due, self._clock + self.flight.after)
        if len(self._wanted.reasons) < MOST_REASONS:
            self._wanted.reasons.append(reason)

    def _keep(self, wanted: Wanted, outcome: str = "") -> None:
        """Closes the current file and joins what is wanted of all of them."""
        self._wanted = None
        self._sink.close(outcome or "goes on")
        segments = list(self._segments)
        if not outcome:
            self._sink = self._open()
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


class _Work:
    """Deletes files and joins others, on a thread of its own, one after the other.

    What deleted files said of operators is folded into a few records each.
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._prologue: dict[str, list[FiringRecord]] = {}
        self._asked: queue.Queue[Callable[[], None] | None] = queue.Queue(MOST_WAITING)
        self._thread = threading.Thread(target=self._run, name="flight recorder", daemon=True)
        self._thread.start()

    def forget(self, segment: Segment) -> None:
        """Deletes a file, when what was asked for before is done; waits where much is asked for already."""
        self._asked.put(partial(self._forget, segment))

    def join(self, segments: list[Segment], part: Part, out: Path, one: dict[str, Any]) -> None:
        """Cuts a span out of some files into a recording; `one` is told how large it is, or what went wrong."""
        self._asked.put(partial(self._join, segments, part, out, one))

    def finish(self) -> None:
        """Returns when everything is done."""
        self._asked.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (act := self._asked.get()) is not None:
            act()

    def _forget(self, segment: Segment) -> None:
        try:
            with Recording(segment.path) as recording:
                log = FiringLog.read(recording)
                for operator in log.operators:
                    self._prologue[operator] = folded([*self._prologue.get(operator, ()), *log.of(operator)])
        except RecordingError as error:  # what follows it is not known then, which verification says
            print(f"flight recorder: {error}", flush=True)
        finally:
            segment.path.unlink(missing_ok=True)

    def _join(self, segments: list[Segment], part: Part, out: Path, one: dict[str, Any]) -> None:
        try:
            records = _records(segments, self._prologue)
            about = {FLIGHT: {"triggers": json.dumps(one["reasons"])}}
            files = [segment.path for segment in segments]
            one["bytes"] = keep_span(files, records, self._graph, part, out, metadata=about).bytes
            print(f"flight recorder: kept {out}: {one['reasons'][0]['what']}", flush=True)
        except Exception as error:  # the run goes on; the failure is said, and stands in its report
            one["error"] = f"{type(error).__name__}: {error}"
            print(f"flight recorder: could not keep {out}: {one['error']}", flush=True)


def _records(segments: list[Segment], prologue: dict[str, list[FiringRecord]]) -> dict[str, list[FiringRecord]]:
    """The firing records of files, behind what stands in for those that were deleted."""
    records = {operator: list(known) for operator, known in prologue.items()}
    for segment in segments:
        with Recording(segment.path) as recording:
            log = FiringLog.read(recording)
            for operator in log.operators:
                records.setdefault(operator, []).extend(log.of(operator))
    for operator, held in segments[0].held.items():
        listed = records.get(operator, [])
        at = next((k for k, record in enumerate(listed) if record.kind == "cut"), None)
        if at is not None:
            cut = listed[at]
            again = cut_record(cut, left_out=0, taken=None, held=held, stamp=cut.stamp)
            listed[at] = FiringRecord(
                cut.operator,
                cut.incarnation,
                cut.index,
                "cut",
                cut.stamp,
                detail={**cut.detail, "held": again.detail["held"]},
            )
    return records
