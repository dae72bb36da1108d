"""Reads the firing records of a recording as they are needed: a record is in memory while it is looked at."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import dropwhile, islice
from typing import Any, NamedTuple, Protocol

from dataflow.recording import Recording, RecordingError
from dataflow.records.firing import CALLS, KINDS, FiringRecord, FiringRecordError, Rows, decode_rows, unpack_batch
from dataflow.records.order import Outline, Outliner, Place, emitted, in_order, merged
from dataflow.sync import InputRef, MessageRef

_BEHIND = (2**63, 0)
_CUT = KINDS.index("cut")


class Maker(Protocol):
    """A node of a graph, as far as its records need it: `outputs` maps its ports to streams, in declared order."""

    @property
    def name(self) -> str: ...

    @property
    def outputs(self) -> Mapping[str, str]: ...


class Lookup(Protocol):
    """The recorded digests of the messages of a stream."""

    def get(self, place: Place) -> bytes | None:
        """The digest of a message by its place; None where no record accounts for it."""


Digests = Mapping[str, Lookup]
"""Stream → the recorded digests of its messages."""


class Heading(NamedTuple):
    """Place, kind and stamp (ns) of a record, which is the one of number `record` in its incarnation."""

    incarnation: int
    record: int
    kind: str
    stamp: int


class FiringLog:
    """The firing records of many operators, read whenever they are asked for.

    `kept`: batches in memory, by operator. Behind them come those of `recording`, all or those from `start` to
    `end` (ns; see `Recording.firings`). `begins`: by operator the index from which on there are all records, where
    those before were not read. `outlines`: how the records of operators lie in the file, where that is known; else a
    pass finds it. `remembers`: records stay in memory once they are decoded; for a few.
    """

    def __init__(
        self,
        kept: Mapping[str, Sequence[bytes]],
        origin: str,
        recording: Recording | None = None,
        *,
        start: int | None = None,
        end: int | None = None,
        begins: Mapping[str, int] | None = None,
        outlines: Mapping[str, Outline] | None = None,
        remembers: bool = False,
    ) -> None:
        self._kept, self._origin, self._recording, self._start, self._end = kept, origin, recording, start, end
        self._remembered: dict[bytes, tuple[FiringRecord, ...]] | None = {} if remembers else None
        self.resumed: FiringRecord | None = None
        """A state that was taken on the way: the records of its operator go on there behind the first `setup()`."""
        self.begins: Mapping[str, int] = begins or {}
        self._outlines = dict(outlines or {})
        stored = [] if recording is None else [n for n, count in recording.firing_batches().items() if count]
        self.operators: Collection[str] = dict.fromkeys([*(name for name in kept if kept[name]), *stored])
        """The operators that left records."""

    @staticmethod
    def read(recording: Recording) -> FiringLog:
        """The records of all operators. Valid until the recording is closed."""
        return FiringLog({}, str(recording.path), recording)

    def to_wire(self) -> dict[str, Any]:
        """Returns what another process needs to read the same records of the same recording, as plain values."""
        outlines = {name: outline.to_wire() for name, outline in self._outlines.items()}
        kept = {name: list(batches) for name, batches in self._kept.items()}
        return {"kept": kept, "start": self._start, "begins": dict(self.begins), "outlines": outlines}

    @staticmethod
    def from_wire(values: Mapping[str, Any], recording: Recording) -> FiringLog:
        """The records that `to_wire` described, read from `recording`. Valid until that is closed."""
        outlines = {name: Outline.from_wire(outline) for name, outline in values["outlines"].items()}
        origin, start, begins = str(recording.path), values["start"], values["begins"]
        return FiringLog(values["kept"], origin, recording, start=start, begins=begins, outlines=outlines)

    def batches(self, operator: str, first: int = 0, end: int | None = None) -> Iterator[bytes]:
        """The batches of one operator as they were recorded, from number `first` on, to the one before `end`."""
        kept = self._kept.get(operator, ())
        yield from kept[first:end]
        if self._recording is not None and operator in self.operators and (end is None or end > len(kept)):
            skipped = max(0, first - len(kept))
            stored = self._recording.firings(operator, self._start, self._end, skip=skipped)
            yield from (payload for _, payload in islice(stored, None if end is None else end - len(kept) - skipped))

    def all_batches(self) -> Iterator[tuple[str, bytes]]:
        """(operator, batch) of all, in one pass over the file; those of each operator in its order."""
        for operator, kept in self._kept.items():
            yield from ((operator, payload) for payload in kept)
        if self._recording is not None:
            yield from self._recording.firings(start=self._start, end=self._end)

    def decoded(self, operator: str, payload: bytes) -> tuple[FiringRecord, ...]:
        """The records of a batch that is filed under an operator. Raises `RecordingError`, with the file and the
        operator."""
        if self._remembered is None:
            return _decoded(payload, operator, self._origin)
        if payload not in self._remembered:
            self._remembered[payload] = _decoded(payload, operator, self._origin)
        return self._remembered[payload]

    def headings(self, maker: Maker) -> Sequence[Heading]:
        """The headings of all records of `maker`, in order. Of records that lie in order no more is decoded."""
        last, found = (-1, -1), list[Heading]()
        for payload in self.batches(maker.name):
            batch = _unpacked(payload, maker.name, self._origin)
            for index, row in enumerate(batch.rows, batch.first):
                if last >= (batch.incarnation, index):
                    return [Heading(r.incarnation, r.index, r.kind, r.stamp) for r in self.ordered(maker)]
                last = batch.incarnation, index
                found.append(Heading(*last, KINDS[row[0]], row[1]))
        return found

    def call_at(self, maker: Maker, place: Place) -> int | None:
        """The number of the record at a place (incarnation, index) among the calls of `maker`, counted from 0 over the
        run; of a record between calls, of the one before it. None before all calls."""
        calls = sum(h.kind in CALLS and (h.incarnation, h.record) <= place for h in self.headings(maker))
        return calls - 1 if calls else None

    def records(self, operator: str, first: int = 0, end: int | None = None) -> Iterator[FiringRecord]:
        """The records of one operator in the order of the file, of the batches from `first` to before `end`.

        Raises `RecordingError` for a batch that is none, with the file and the operator.
        """
        for payload in self.batches(operator, first, end):
            yield from self.decoded(operator, payload)

    def of(self, operator: str) -> tuple[FiringRecord, ...]:
        """All records of one operator in memory, in the order of the file: some hundred bytes each."""
        return tuple(self.records(operator))

    def outline(self, maker: Maker) -> Outline:
        """Returns how the records of `maker` lie in the file."""
        if maker.name not in self._outlines:
            found = Outliner(tuple(maker.outputs.values()))
            for number, payload in enumerate(self.batches(maker.name)):
                batch = _unpacked(payload, maker.name, self._origin)
                try:
                    found.take_batch(number, batch)
                except (TypeError, IndexError):
                    self.decoded(maker.name, payload)  # names the damage
                    raise
            self.outlined(maker, found)
        return self._outlines[maker.name]

    def outlined(self, maker: Maker, found: Outliner) -> None:
        """Notes the outline that a pass over all of a maker's records has found."""
        self._outlines[maker.name] = found.done(partial(self.records, maker.name))

    def since(self, maker: Maker, begin: Place) -> Iterator[FiringRecord]:
        """The records of `maker` from a place (incarnation, index) on, in that order, each once."""
        runs = [run.since(begin) for run in self.outline(maker).runs]
        records = in_order(runs, partial(self.records, maker.name))
        return dropwhile(lambda record: (record.incarnation, record.index) < begin, records)

    def repeated(self, maker: Maker) -> Iterator[FiringRecord]:
        """The records of `maker` by (incarnation, index); of several with one place, the first of the file first."""
        return merged(self.outline(maker).runs, partial(self.records, maker.name))

    def ordered(self, maker: Maker) -> Iterator[FiringRecord]:
        """The records of `maker` by (incarnation, index), each once."""
        runs = self.outline(maker).runs
        read = partial(self.records, maker.name)
        records = read(0, runs[0].end) if len(runs) == 1 else in_order(runs, read)
        at = self.resumed
        return records if at is None or maker.name != at.operator else _resumed(records, at)

    def emissions(self, maker: Maker, stream: str) -> Iterator[tuple[Place, bytes]]:
        """(place, digest) of what `maker` sent on a stream, by its records, in the order of the places."""
        outline, outputs = self.outline(maker), tuple(maker.outputs.values())
        if stream not in outline.scattered and len(outline.runs) == 1:
            return self._sent(maker.name, outputs, stream)
        records = self.records(maker.name) if stream in outline.scattered else self.ordered(maker)
        told = ((place, digest) for r in records for name, place, digest in emitted(r, outputs) if name == stream)
        return iter(sorted(dict(told).items())) if stream in outline.scattered else told

    def _sent(self, operator: str, outputs: Sequence[str], stream: str) -> Iterator[tuple[Place, bytes]]:
        """(place, digest) of what was sent on a stream, in the order of the file. Decodes no more than that."""
        port = outputs.index(stream)
        for payload in self.batches(operator):
            batch = unpack_batch(payload)
            if any(row[0] == _CUT for row in batch.rows):
                for record in decode_rows(batch):
                    yield from ((at, digest) for name, at, digest in emitted(record, outputs) if name == stream)
                continue
            for row in batch.rows:
                made = row[6][port] if port < len(row[6]) else None
                if made is not None and made[0] >= 0:
                    yield (batch.incarnation, made[0]), made[2]

    def digests(self, makers: Iterable[Maker], streams: Collection[str]) -> Digests:
        """Returns what `makers` sent on `streams`, by their records: to be asked for in the order of each stream."""
        made = {stream: maker for maker in makers for stream in maker.outputs.values()}
        return {stream: RecordedDigests(self, made[stream], stream) for stream in streams if stream in made}


def _resumed(records: Iterator[FiringRecord], at: FiringRecord) -> Iterator[FiringRecord]:
    """The first `setup()`, then the state, then what followed."""
    yield next(records)
    yield at
    yield from (r for r in records if (r.incarnation, r.index) > (at.incarnation, at.index))


class RecordedDigests:
    """The digests of the messages of one stream, read along with the messages: asked for in their order."""

    def __init__(self, log: FiringLog, maker: Maker, stream: str) -> None:
        self._read = partial(log.emissions, maker, stream)
        self._ahead: Iterator[tuple[Place, bytes]] | None = None
        self._next: tuple[Place, bytes] | None = None
        self._asked: Place | None = None
        self._all: Mapping[Place, bytes] | None = None
        """All of them, once one was asked for that lies behind."""

    def get(self, place: Place) -> bytes | None:
        """The digest of a message by its place; None where no record accounts for it."""
        if self._all is None and self._asked is not None and place < self._asked:
            self._all = dict(self._read())
        if self._all is not None:
            return self._all.get(place)
        if self._ahead is None:
            self._ahead = self._read()
            self._next = next(self._ahead, None)
        self._asked = place
        while self._next is not None and self._next[0] < place:
            self._next = next(self._ahead, None)
        return self._next[1] if self._next is not None and self._next[0] == place else None


def recorded_firings(recording: Recording, operator: str) -> Iterator[FiringRecord]:
    """The firing records of one operator, in the order of the file. Raises `RecordingError`."""
    for _, payload in recording.firings(operator):
        yield from _decoded(payload, operator, str(recording.path))


def _decoded(payload: bytes, operator: str, origin: str) -> tuple[FiringRecord, ...]:
    batch = _unpacked(payload, operator, origin)
    try:
        return decode_rows(batch)
    except FiringRecordError as error:
        raise _damaged(operator, origin, error) from error


def _unpacked(payload: bytes, operator: str, origin: str) -> Rows:
    try:
        batch = unpack_batch(payload)
    except FiringRecordError as error:
        raise _damaged(operator, origin, error) from error
    if batch.operator != operator:
        raise RecordingError(
            f"{origin}: a batch of firing records of operator {batch.operator!r} is filed under {operator!r}"
        )
    return batch


def _damaged(operator: str, origin: str, error: FiringRecordError) -> RecordingError:
    return RecordingError(f"{origin}: firing records of operator {operator!r} are damaged: {error}")


def first_places(ref: InputRef) -> Sequence[tuple[str, tuple[int, int]]]:
    """(stream, (incarnation, number)) of the first message that a reference names on each stream."""
    match ref:
        case None:
            return ()
        case MessageRef():
            return ((ref.stream, (ref.incarnation, ref.seq)),)
        case tuple():
            return [(run.stream, (run.incarnation, run.first_seq)) for run in ref]
        case _:
            return [(one.stream, (one.incarnation, one.seq)) for one in ref.values()]


def note_taken(needed: dict[str, tuple[int, int]], record: FiringRecord) -> None:
    """Notes in `needed` the first message (incarnation, number) of each stream that the call of a record took, where it
    lies before the one that is noted."""
    for ref in record.inputs.values():
        for stream, place in first_places(ref):
            if place < needed.get(stream, _BEHIND):
                needed[stream] = place


class Repeatable:
    """Follows the records of an operator in the order of its calls, and finds those that can be repeated.

    Where records are missing, those after them in the same incarnation cannot be: the operator's state there is not
    known. The next incarnation begins from `setup()` again (or, after a jump of the clock, does not).
    """

    def __init__(self) -> None:
        self._following = (0, 0)
        self._known = True

    def take(self, record: FiringRecord) -> bool | None:
        """Returns whether the next record can be repeated; None for one that comes again, handed over twice when its
        process died."""
        place, following = (record.incarnation, record.index), self._following
        if place < following:
            return None
        if record.kind == "cut":
            self._known = True
        elif record.incarnation > following[0] or not following[1]:
            self._known = record.index == 0 and (record.kind != "reset" or self._known)
        else:
            self._known = self._known and place == following
        self._following = (record.incarnation, record.index + 1)
        return self._known


def whole(records: Iterable[FiringRecord]) -> tuple[list[FiringRecord], int]:
    """The records in the order of the calls that can be repeated, each once, and how many calls had to be left out."""
    follower = Repeatable()
    told = [(r, follower.take(r)) for r in sorted(records, key=lambda r: (r.incarnation, r.index))]
    lost = sum(record.kind in CALLS for record, known in told if known is False)
    return [record for record, known in told if known], lost
