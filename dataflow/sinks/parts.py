"""The recorder of a run: writes one file, or parts one after the other, and goes on after a full disk.

Each part is a recording by itself: it holds the run's metadata, the static messages, the packets of video since the
last key frame, and for every operator, in front of its first record, one that stands in for those before
(`dataflow.records.cuts`). So parts before it may be missing,
because they were deleted or because the disk was full, and all that are there join into one recording again.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dataflow.editing.joins import holding
from dataflow.editing.spans import folded
from dataflow.graph.model import Graph
from dataflow.messages import CompressedVideo, Diagnostics
from dataflow.messages.base import Message
from dataflow.recording import LogLine, RecordingError
from dataflow.recording.layout import CUT
from dataflow.recording.parts import Storage, part_path, parts_of
from dataflow.recording.streams.cutting import Cut
from dataflow.records.cuts import OrphanedMessage
from dataflow.records.firing import CALLS, FiringRecord, consecutive, encode_batch
from dataflow.sinks.outage import Outage, RecordingLosses
from dataflow.sinks.recorder import GOES_ON, RecorderSink
from dataflow.sinks.sink import StreamSink
from dataflow.video.group import Groups

SETTLES = 1.0
"""Seconds for which a full part stays open for what lies before its end: batches of firing records come later."""


@dataclass(slots=True)
class Part:
    """One file. `start`: the stamp (ns) with which it begins, None for the beginning of the run; `ready`: when it may
    be closed (s, steady); `repeated`: messages in front that the part before holds, too; `front`: bytes of all that
    stands in front; `messages` and `bytes`: what it holds, once it is closed."""

    path: Path
    sink: RecorderSink
    start: int | None
    repeated: Counter[str]
    ready: float = 0.0
    front: int = 0
    messages: int = 0
    bytes: int = 0
    abandoned: bool = False


class PartsSink(StreamSink):
    """Takes everything that a run gives, and stores it in the files of one recording.

    `options`: those of `RecorderSink`, and `storage`. `life`: how many recorders the run has had, this one included.
    """

    def __init__(
        self, path: Path, graph: Graph, streams: list[str], options: Mapping[str, Any], *, life: int = 1
    ) -> None:
        self._path, self._graph, self._streams, self._options = path, graph, streams, options
        self._storage: Storage = options["storage"]
        self._before = life - 1
        self._earlier: dict[Path, int] = {}
        """Parts of the recorders before, and their sizes."""
        self._splits = self._storage.splitting.splits
        self._numbered = self._splits or life > 1
        self._continues = self._splits or self._storage.on_failure == "go_on"
        """True where a part may follow: it needs the sum of the records before it."""
        self._static = {stream for stream in streams if graph.streams[stream].static}
        self._statics: dict[str, tuple[Message, int, int]] = {}
        self._groups = Groups[tuple[Message, int, int]]()
        self._held: dict[str, list[OrphanedMessage]] = {}
        """By operator, the packets of video in front of the current part."""
        self._folded: dict[str, list[FiringRecord]] = {}
        self._introduced: set[str] = set()
        self._ends: dict[str, tuple[int | None, str]] = {}
        self._clock = self._begun = self._diagnosed = 0
        self._given: Counter[str] = Counter()
        self._saved: Counter[str] = Counter()
        self._copied: set[tuple[str, int, int]] = set()
        """Static messages that lie in front of a part: the first of them may be in no file."""
        self._closed: list[Part] = []
        self._deleted = 0
        self._full: Part | None = None
        """The part before the current one, until what belongs into it has come."""
        self._after_gap = False
        self._lives: dict[str, int] = {}
        """The newest incarnation of each stream and operator."""
        self._outage = Outage(path.parent)
        self.lost = RecordingLosses()
        if options["overwrite"] and self._splits and life == 1:
            for old in parts_of(path):
                old.unlink()
        elif life > 1 and self._splits:
            self._earlier = {file: file.stat().st_size for file in parts_of(path)}
        self._current: Part | None = self._open(None)

    # What comes

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        """Stores a message; begins the next part when it is time to."""
        self._given[stream] += 1
        self._live(stream, incarnation)
        self._groups.begin(stream, message, incarnation)
        if stream in self._static:
            self._statics[stream] = message, seq, incarnation
        else:
            self._advance(message.stamp)
        part = self._part_of(stream, message)
        if part is not None:
            try:
                part.sink.message(stream, message, seq, incarnation)
            except RecordingError as error:
                self._failed(part, error)
        self._groups.add(stream, message, (message, seq, incarnation))

    def firings(self, operator: str, records: Sequence[FiringRecord], payload: bytes) -> None:
        """Stores firing records; those of calls before the current part in the one before, while it is open."""
        self._live(operator, records[0].incarnation)
        if self._static.issuperset(self._streams):  # no message shows how far the run is
            self._advance(records[-1].stamp)
        start = None if self._current is None else self._current.start
        k = 0 if start is None else next((k for k, r in enumerate(records) if r.stamp >= start), len(records))
        if self._full is None and not self._after_gap:
            k = 0
        early, rest = list(records[:k]), list(records[k:])
        if early:
            self._store_records(self._full, operator, early, encode_batch(early))
        if rest:
            payload = encode_batch(rest, last=rest[-1].kind == "finish") if early else payload
            self._store_records(self._current, operator, rest, payload)

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self._ends[stream] = final_stamp, reason

    def event(self, name: str, stamp: int, data: Mapping[str, Any]) -> None:
        """Takes an event. After a jump of the clock, stamps are new again that were old before."""
        if name == "clock_jump":
            self._clock = min(self._clock, data["stamp"])
            self._begun = min(self._begun, self._clock)
        if (part := self._current) is not None:
            self._store(part, lambda: part.sink.event(name, stamp, data))

    def diagnostics(self, message: Diagnostics) -> None:
        if (part := self._current) is not None:
            part.sink.diagnosed = self._diagnosed
            self._store(part, lambda: part.sink.diagnostics(message))
        self._diagnosed += 1

    def log(self, line: LogLine) -> None:
        if (part := self._current) is not None:
            self._store(part, lambda: part.sink.log(line))

    def flush(self) -> None:
        """Hands everything to the operating system, about once a second; a disk that had refused is tried again."""
        for part in self._open_parts():
            self._store(part, part.sink.flush)
        if self._full is not None and time.monotonic() >= self._full.ready:
            self._close_full()
        if self._current is None and self._outage.over():
            self._resume()
        self._keep_to_limit()

    def close(self, outcome: str) -> Mapping[str, Any]:
        """Completes the last part."""
        self._introduce_all()
        self._close_full()
        if (part := self._current) is not None:
            self._current = None
            self._finish(part, outcome, None)
        for stream, copies in Counter(stream for stream, *_ in self._copied).items():
            self._saved[stream] = max(self._saved[stream], copies)
        self.lost.messages = self._given - self._saved
        self._keep_to_limit()
        facts = {
            "path": str(self._closed[0].path if self._closed else self._path),
            "messages": sum(part.messages for part in self._closed),
            "bytes": self.size,
            "parts": [str(part.path) for part in self._closed],
            "deleted": self._deleted,
            "deaths": self._before,
        }
        return {**facts, "lost": self.lost.as_json()} if self.lost.any else facts

    @property
    def size(self) -> int:
        """Bytes of all parts that there are."""
        closed = sum(part.bytes for part in self._closed) + sum(self._earlier.values())
        return closed + sum(part.sink.writer.saved_bytes for part in self._open_parts())

    def _advance(self, stamp: int) -> None:
        """Takes note of how far event time is; begins the next part when it is time to."""
        if stamp > self._clock:
            self._clock = stamp
            self._begun = self._begun or self._clock
            if self._current is not None and self._splits and self._is_full(self._current):
                self._split(self._clock)

    def _live(self, name: str, incarnation: int) -> None:
        """Notes the incarnation of a stream or an operator. Behind a jump of the clock, stamps are new again that lie
        in the part before: everything goes into the current one from there on."""
        if incarnation > self._lives.setdefault(name, incarnation):
            self._lives[name] = incarnation
            self._after_gap = False
            self._close_full()

    # Parts

    def _open_parts(self) -> Iterator[Part]:
        yield from [part for part in (self._full, self._current) if part is not None]

    def _is_full(self, part: Part) -> bool:
        return self._storage.splitting.due(part.sink.writer.saved_bytes, self._clock - self._begun, part.front)

    def _part_of(self, stream: str, message: Message) -> Part | None:
        """The part into which a message belongs; None where it is lost. Behind a full disk that is also the one whose
        record is: it came late. A packet of video stays, as those after it need it."""
        current = self._current
        late = current is not None and message.stamp < (current.start or 0)
        if late and self._full is not None:
            return self._full
        stays = stream in self._static or isinstance(message, CompressedVideo)
        return None if late and self._after_gap and not stays else current

    def _open(self, start: int | None) -> Part:
        """Begins a file with what every part holds. Raises `RecordingError`."""
        path = self._free_name()
        options = {**self._options, "mode": self._storage.mode}
        if start is not None:
            options["metadata"] = {**options["metadata"], CUT: Cut(self._path.name, start, None).metadata()}
        try:
            sink = RecorderSink(path, self._graph, self._streams, options)
        except RecordingError:
            if start is not None:
                path.unlink(missing_ok=True)
            raise
        self._introduced.clear()
        self._held.clear()
        part = Part(path, sink, start, Counter(self._statics.keys() if start is not None else ()))
        try:
            for stream, (message, seq, incarnation) in self._statics.items():
                sink.message(stream, message, seq, incarnation)
            self._repeat_groups(part)
        except RecordingError:
            self._abandon(part)
            raise
        part.front = sink.writer.given_bytes
        return part

    def _repeat_groups(self, part: Part) -> None:
        """Puts the packets since the last key frame of each video in front, so that the part decodes by itself."""
        for stream, (packet, seq, incarnation) in self._groups:
            part.sink.message(stream, packet, seq, incarnation)
            part.repeated[stream] += 1
            held = self._held.setdefault(self._graph.streams[stream].node, [])
            held.append(OrphanedMessage(stream, incarnation, seq, packet.stamp, packet.digest()))

    def _free_name(self) -> Path:
        """The name of the next part. None is used twice, not even that of one that was deleted."""
        if not self._numbered:
            self._numbered = True
            return self._path
        first = self._before + len(self._closed) + self._deleted + (self._full is not None)
        numbers = range(first, first + 10**6)
        names = (part_path(self._path, number) for number in numbers)
        return next(name for name in names if not name.exists())

    def _split(self, start: int) -> None:
        self._introduce_all()
        self._close_full()
        self._full, self._current = self._current, None
        assert self._full is not None
        self._full.ready = time.monotonic() + SETTLES
        self._after_gap = False
        self._begin(start)

    def _begin(self, start: int) -> None:
        try:
            self._current = self._open(start)
        except RecordingError as error:
            self._refused(error)
        else:
            self._begun = start

    def _resume(self) -> None:
        start = self._clock + 1
        self._begin(start)
        part = self._current
        if part is None:
            return
        self._after_gap = True
        since, _ = self.lost.spans[-1]
        self.lost.spans[-1] = since, start
        text = f"recording goes on in {part.path}: {(start - since) * 1e-9:.1f} s are not recorded"
        print(text, flush=True)
        self._store(part, lambda: part.sink.event("not_recorded", start, {"text": text, "since": since}))

    def _close_full(self) -> None:
        if (part := self._full) is not None:
            self._full = None
            following = self._current.start if self._current is not None else None
            self._finish(part, GOES_ON, (following or self._clock + 1) - 1)

    def _finish(self, part: Part, outcome: str, end: int | None) -> None:
        """Completes a part, which ends with the stamp `end`; None: with the run."""

        def finish() -> None:
            for stream, (final, reason) in self._ends.items():
                part.sink.end(stream, final, reason)
            if end is not None:
                part.sink.writer.add_metadata(CUT, Cut(self._path.name, part.start, end).metadata())
            part.sink.close(outcome)

        self._store(part, finish)
        if not part.sink.writer.failed:
            self._count(part)

    def _abandon(self, part: Part) -> None:
        """Closes a file whose disk refuses, once: more than one thing may be refused before that is noticed."""
        if part.abandoned:
            return
        part.abandoned = True
        with suppress(RecordingError):  # the refusal once more; the file is closed
            part.sink.writer.close()
        self.lost.firings += part.sink.unsaved_calls
        self._count(part)

    def _count(self, part: Part) -> None:
        saved = Counter({stream: part.sink.writer.saved(stream) for stream in self._streams})
        self._saved += saved - part.repeated
        part.messages, part.bytes = (saved - part.repeated).total(), part.sink.writer.saved_bytes
        if part.start is None or self._holds_any(part):
            self._closed.append(part)
            held = self._statics.items()
            self._copied |= {(name, i, k) for name, (_, i, k) in held if part.repeated[name] and saved[name]}
        else:  # the disk refused before it held anything
            part.path.unlink(missing_ok=True)

    def _keep_to_limit(self) -> None:
        """Deletes the oldest parts while all together take more of the disk than they may; the newest one that holds
        anything stays."""
        most = self._storage.keep
        while most is not None and self._has_older() and self.size > most:
            oldest = next(iter(self._earlier)) if self._earlier else self._closed.pop(0).path
            self._earlier.pop(oldest, None)
            oldest.unlink(missing_ok=True)
            self._deleted += 1

    def _has_older(self) -> bool:
        older = len(self._earlier) + len(self._closed)
        return older > (0 if any(map(self._holds_any, self._open_parts())) else 1)

    def _holds_any(self, part: Part) -> bool:
        """Returns whether anything is in a part but what is in front of each."""
        saved = part.sink.writer.saved
        return part.sink.saved_calls > 0 or any(saved(stream) > part.repeated[stream] for stream in self._streams)

    # Firing records

    def _store_records(self, part: Part | None, operator: str, records: Sequence[FiringRecord], payload: bytes) -> None:
        """Stores records of an operator, behind what stands in for those before the part; without one they are lost."""
        calls = sum(record.kind in CALLS for record in records)
        if part is None:
            self.lost.firings += calls
        else:
            if part is self._current:
                self._introduce(part, operator)
            self._store(part, lambda: part.sink.firings(operator, records[-1].stamp, payload, calls=calls))
        if self._continues:
            self._folded[operator] = folded([*self._folded.get(operator, ()), *records])

    def _introduce(self, part: Part, operator: str) -> None:
        """Puts what stands in for the operator's records before a part into it, once."""
        if operator not in self._introduced:
            self._introduced.add(operator)
            given = part.sink.writer.given_bytes
            for before in consecutive(holding(self._folded.get(operator, ()), self._held.get(operator, ()))):
                self._store(part, partial(part.sink.firings, operator, part.start or 0, encode_batch(before)))
            part.front += max(0, part.sink.writer.given_bytes - given)  # less where a chunk was compressed

    def _introduce_all(self) -> None:
        """Does so for those that have not been called in the current part: their records may still come, or none."""
        for operator in self._folded:
            if self._current is not None:
                self._introduce(self._current, operator)

    # Failures

    def _store(self, part: Part, act: Callable[[], object]) -> None:
        """Does what stores something in a part; where that fails, the run goes on or ends, as it is to."""
        try:
            act()
        except RecordingError as error:
            self._failed(part, error)

    def _failed(self, part: Part, error: RecordingError) -> None:
        """Ends the run with a refusal, or goes on without what was refused."""
        if self._storage.on_failure != "go_on":
            raise error
        if not part.sink.writer.failed:  # it refuses this one thing alone
            if self.lost.because(str(error)):
                print(f"not recorded: {error}", flush=True)
            return
        was_current = part is self._current
        self._full = None if part is self._full else self._full
        self._current = None if was_current else self._current
        self._abandon(part)
        if was_current:
            self._refused(error)
        elif self.lost.because(str(error)):
            print(f"the end of a file is not recorded: {error}", flush=True)

    def _refused(self, error: RecordingError) -> None:
        """Nothing is recorded from here on, until the disk takes something again."""
        if self._storage.on_failure != "go_on":
            raise error
        self._outage.begin()
        self.lost.because(str(error))
        if not self.lost.spans or self.lost.spans[-1][1] is not None:
            self.lost.spans.append((self._clock, None))
            print(f"recording stops, the run goes on: {error}", flush=True)
