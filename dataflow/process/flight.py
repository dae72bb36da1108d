"""The flight recorder: the last seconds of a run in a ring of files; what a trigger asks for is kept.

Each file of the ring is a recording of some seconds, with the newest message of every stream in front. What a deleted
file said of operators that still matters (their parameters, how often they were set up) is folded into a few records.
"""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dataflow.editing.part import Part
from dataflow.editing.rolling import keep_span
from dataflow.editing.spans import folded
from dataflow.graph.model import Flight, Graph
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message
from dataflow.process.recorder import RecorderSink
from dataflow.process.triggers import Triggers
from dataflow.recording import LogLine, Recording
from dataflow.recording.layout import FLIGHT
from dataflow.records.cuts import Held, cut_record
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.sync.stamps import format_stamp

PARTS = 6
"""Files into which the time to keep is divided."""
MOST_REASONS = 100
"""Triggers that one recording names."""
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
    """When it was seen that it is over (s, steady); 0 until then."""


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
        """The surplus over what is to be kept: from a state of every operator on."""
        self._clock = 0
        self._first: int | None = None
        self._newest: dict[str, tuple[Message, int, int]] = {}
        self._prologue: dict[str, list[FiringRecord]] = {}
        self._segments: deque[Segment] = deque()
        self._made = 0
        self._begun = 0
        self._triggers = Triggers(flight.when)
        self._wanted: Wanted | None = None
        self._joining: threading.Thread | None = None
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
        if self._joining is not None:
            self._joining.join()
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
        return sum(file.stat().st_size for file in self._ring.iterdir())

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
        if self._joining is None or not self._joining.is_alive():
            self._forget()

    def _forget(self) -> None:
        """Deletes the files that nobody can ask for any more."""
        start = self._clock - self.flight.keep
        if self._wanted is not None:
            start = min(start, self._wanted.start)
        while len(self._segments) > 2:
            if (self._segments[1].begin or 0) > start - self.slack and not self._is_full():
                return
            oldest = self._segments.popleft()
            with Recording(oldest.path) as recording:
                log = FiringLog.read(recording)
                for operator in log.operators:
                    self._prologue[operator] = folded([*self._prologue.get(operator, ()), *log.of(operator)])
            oldest.path.unlink()

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
        return time.monotonic() - wanted.over >= self._options["settle"]

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
        if self._joining is not None:
            self._joining.join()
        if outcome:
            self._sink.close(outcome)
        else:
            self._sink.close("goes on")
        segments = list(self._segments)
        prologue = {operator: list(records) for operator, records in self._prologue.items()}
        if not outcome:
            self._sink = self._open()
        whole_beginning = not self._prologue and (self._first or 0) >= wanted.start
        to_the_end = outcome and self._clock <= wanted.due
        part = Part(None if whole_beginning else wanted.start, None if to_the_end else wanted.due)
        name = f"{self.graph.name}_{format_stamp(wanted.reasons[0]['stamp']).replace(':', '').partition('.')[0]}"
        out = self._free(name)
        one: dict[str, Any] = {"path": str(out), "reasons": wanted.reasons, "bytes": 0}
        self._kept.append(one)
        self._joining = threading.Thread(
            target=self._join, args=(segments, prologue, part, out, one), name="flight recorder", daemon=True
        )
        self._joining.start()

    def _free(self, name: str) -> Path:
        """A file name that is free, and that nothing kept before has."""
        taken = {one["path"] for one in self._kept}
        numbered = (self.folder / f"{name}{f'_{k}' if k else ''}.mcap" for k in range(10_000))
        return next(path for path in numbered if not path.exists() and str(path) not in taken)

    def _join(
        self,
        segments: list[Segment],
        prologue: dict[str, list[FiringRecord]],
        part: Part,
        out: Path,
        one: dict[str, Any],
    ) -> None:
        try:
            records = _records(segments, prologue)
            about = {FLIGHT: {"triggers": json.dumps(one["reasons"])}}
            files = [segment.path for segment in segments]
            one["bytes"] = keep_span(files, records, self.graph, part, out, metadata=about).bytes
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
