"""Firing records of a span of a recorded run, and the messages that its firings need from beyond it.

Every operator is taken up after its last recorded state at or before the span, and repeated from there. So the part
holds, besides the span, what its firings took before it. An operator without a recorded state begins with the span.
The records are read several times, one after the other; what stays in memory is a sum of each few hundred of them.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from dataflow.editing.joins import holding
from dataflow.records.cuts import OrphanedMessage, ResumePoint, code_in, cut_record, held_by, is_known, taken_by
from dataflow.records.firing import CALLS, WITHHELD, FiringRecord
from dataflow.records.order import Place
from dataflow.records.reading import Repeatable
from dataflow.sync import messages_of

Stamps = Mapping[str, Mapping[int, Collection[int]]]
"""Stream → incarnation → stamps."""
Span = tuple[int | None, int | None]
"""The first and the last stamp (ns; None: not cut there)."""
Read = Callable[[Place], Iterator[FiringRecord]]
"""Reads the records of an operator from a place (incarnation, index) on, in that order, each once."""

START: Place = (-1, -1)
SEGMENT = 512
"""Records that are summed up together."""
NEVER = -(2**63)
UNCHANGED = ResumePoint(again=False, at_setup={}, since={}, state=None)


@dataclass(frozen=True, slots=True)
class SpanRecords:
    """The firing records of a span, by operator, and what they need.

    `records` are read whenever they are iterated over. `needed`: messages outside of the span that they took or made.
    `unknown`: operators whose calls before the span were left out and that gave no state by then: they verify only
    where they have none. `lead`: the stamp from which operators are repeated (ns), where that is before the span.
    """

    records: Mapping[str, Iterable[FiringRecord]]
    needed: Stamps
    unknown: tuple[str, ...]
    lead: int | None


class RunRecords:
    """The firing records of a run, of which those of spans are chosen.

    `log`: reads the records of each operator; `outputs`: its streams in the order of its ports.
    """

    def __init__(self, log: Mapping[str, Read], outputs: Mapping[str, Sequence[str]]) -> None:
        self._logs = {name: _Log(read, tuple(outputs.get(name, ()))) for name, read in log.items()}
        self._makers = {stream: name for name, streams in outputs.items() for stream in streams if name in log}

    def of_span(
        self, stored: Collection[str], start: int | None, end: int | None, span: Callable[[str], Span]
    ) -> SpanRecords:
        """Chooses the records of the span from `start` to `end` (ns, inclusive; None: not cut there).

        `stored`: the streams that the recording holds. Other streams are made again, so their producers are repeated
        from where it is needed. `span`: that from which the messages of a stream are taken over.
        """
        chosen = {name: _Chosen(log, stop=log.stop(end)) for name, log in self._logs.items()}
        if start is not None:
            self._choose_first(chosen, stored, start)
        needed, lead = self._needed(chosen, _Within(span))
        for each in chosen.values():
            each.hold(stored, needed, _Within(span))
        unknown = tuple(sorted(name for name, each in chosen.items() if each.left_out and not each.is_known))
        before = lead if lead is not None and start is not None and lead < start else None
        return SpanRecords(chosen, needed, unknown, before)

    def _choose_first(self, chosen: Mapping[str, _Chosen], stored: Collection[str], start: int) -> None:
        """Sets the first record that is kept of each operator."""
        bounds = dict.fromkeys(chosen, start - 1)  # a state at `start` has seen what lies there
        for name, each in chosen.items():
            each.begin(bounds[name], start)
        made_again = self._makers.keys() - set(stored)
        moved = list(chosen) if made_again else []
        while moved:
            look = _Outside(chosen, self._makers, made_again)
            for record in chosen[moved.pop()].kept():
                look.take(record)
            for stream, held in look.found():
                maker = self._makers[stream]
                if held.stamp - 1 < bounds[maker]:
                    bounds[maker] = held.stamp - 1
                    chosen[maker].begin(bounds[maker], start)
                    moved.append(maker)

    def _needed(
        self, chosen: Mapping[str, _Chosen], within: _Within
    ) -> tuple[dict[str, dict[int, set[int]]], int | None]:
        """The stamps of messages outside of the span that kept calls took or made; the first stamp of a call of an
        operator that is taken up on the way."""
        needed: dict[str, dict[int, set[int]]] = {}
        lead: int | None = None

        def note(stream: str, incarnation: int, stamp: int) -> None:
            if not within(stream, stamp):
                needed.setdefault(stream, {}).setdefault(incarnation, set()).add(stamp)

        look = _Outside(chosen, self._makers, self._makers.keys())
        for each in chosen.values():
            for record in each.kept():
                look.take(record)
                if record.kind in CALLS:
                    if each.left_out and (lead is None or record.stamp < lead):
                        lead = record.stamp
                    for stream, made in _emitted(record, each.log.streams):
                        note(stream, record.incarnation, made.stamp)
                        each.told(stream, (record.incarnation, made.seq))
        for stream, held in look.found():
            note(stream, held.incarnation, held.stamp)
        return needed, lead


class _Within:
    """Returns whether stamps of a stream lie within its span."""

    def __init__(self, span: Callable[[str], Span]) -> None:
        self._span = span

    def __call__(self, stream: str, low: int, high: int | None = None) -> bool:
        """Returns whether any stamp from `low` to `high` (that alone, if None) does."""
        first, last = self._span(stream)
        return (first is None or (low if high is None else high) >= first) and (last is None or low <= last)


@dataclass(slots=True)
class _Sent:
    """What the calls of a segment sent on a stream: the least and the largest stamp and place."""

    low: int
    high: int
    first: Place
    last: Place


@dataclass(slots=True)
class _Segment:
    """Consecutive records of an operator. `begin`: the place of the first one; `before`: of the one in front of it;
    `calls`: how many lie before it; `newest`: the largest stamp of a call."""

    begin: Place
    before: Place
    calls: int
    newest: int = NEVER
    sent: dict[str, _Sent] = field(default_factory=dict)


class _State(NamedTuple):
    """Place and stamp of a recorded state, how many calls lie before it, and whether none of these is missing."""

    place: Place
    stamp: int
    calls: int
    sound: bool


class _Log:
    """Sums up the records of one operator; they are read again where more is needed."""

    def __init__(self, read: Read, streams: tuple[str, ...]) -> None:
        self.read, self.streams = read, streams
        self.first: FiringRecord | None = None
        self.last, self.calls = START, 0
        self.segments: list[_Segment] = []
        self.states: list[_State] = []
        self.parameters: list[tuple[Place, ResumePoint]] = []
        """The changed parameters behind a record that changes them."""
        self.held: dict[str, dict[Place, OrphanedMessage]] = {}
        """Messages that `cut` records account for."""
        self.apart: dict[str, dict[Place, tuple[FiringRecord, OrphanedMessage]]] = {}
        """Messages of records that are no calls: static ones."""
        self.scattered: set[str] = set()
        """Streams whose messages do not increase in number from record to record."""
        self._sound: list[tuple[Place, bool]] = []
        self._newest: dict[str, Place] = {}
        self._follower = Repeatable()
        for number, record in enumerate(read(START)):
            self._take(number, record)

    def _take(self, number: int, record: FiringRecord) -> None:
        place = (record.incarnation, record.index)
        if number % SEGMENT == 0:
            self.segments.append(_Segment(place, self.last, self.calls))
        if self.first is None:
            self.first = record
        sound = self._follower.take(record) is True
        if not self._sound or self._sound[-1][1] != sound:
            self._sound.append((place, sound))
        if is_known(record):
            self.states.append(_State(place, record.stamp, self.calls, sound))
        known = self.parameters[-1][1] if self.parameters else UNCHANGED
        if (changed := _changed(known, record, first=record is self.first)) is not known:
            self.parameters.append((place, changed))
        for held in held_by(record):
            if held.stream in self.streams:
                self.held.setdefault(held.stream, {}).setdefault(held.place, held)
        self._note_sent(self.segments[-1], record)
        self.last = place

    def _note_sent(self, segment: _Segment, record: FiringRecord) -> None:
        call = record.kind in CALLS
        if call:
            self.calls += 1
            segment.newest = max(segment.newest, record.stamp)
        for stream, made in _emitted(record, self.streams):
            place = (record.incarnation, made.seq)
            if not call:
                held = OrphanedMessage(stream, *place, made.stamp, made.digest)
                self.apart.setdefault(stream, {})[place] = record, held
                continue
            if place <= self._newest.get(stream, START):
                self.scattered.add(stream)
            self._newest[stream] = place
            sent = segment.sent.get(stream)
            if sent is None:
                segment.sent[stream] = _Sent(made.stamp, made.stamp, place, place)
            else:
                sent.low, sent.high = min(sent.low, made.stamp), max(sent.high, made.stamp)
                sent.first, sent.last = min(sent.first, place), max(sent.last, place)

    def of_segment(self, number: int) -> Iterator[FiringRecord]:
        """The records of a segment."""
        end = self.segments[number + 1].begin if number + 1 < len(self.segments) else None
        for record in self.read(self.segments[number].begin):
            if end is not None and (record.incarnation, record.index) >= end:
                return
            yield record

    def stop(self, end: int | None) -> Place | None:
        """The place of the first record that is left out again, where the span ends with the stamp `end`."""
        for number, segment in enumerate(self.segments):
            if end is not None and segment.newest > end:
                records = self.of_segment(number)
                return next((r.incarnation, r.index) for r in records if r.kind in CALLS and r.stamp > end)
        return None

    def left_out(self, bound: int, start: int) -> tuple[Place, int] | None:
        """The last record to leave out, and how many calls are: the last state at or before the stamp `bound`, else
        what lies before the first call from `start` on. None where no call is left out."""
        state = next((s for s in reversed(self.states) if s.sound and s.stamp <= bound), None)
        if state is not None:
            return (state.place, state.calls) if state.calls else None
        number = next((n for n, segment in enumerate(self.segments) if segment.newest >= start), None)
        if number is None:
            return (self.last, self.calls) if self.calls else None
        before, calls = self.segments[number].before, self.segments[number].calls
        for record in self.of_segment(number):
            place = (record.incarnation, record.index)
            if record.kind in CALLS and record.stamp >= start:
                sound = self._sound[bisect_right(self._sound, place, key=lambda item: item[0]) - 1][1]
                return (before, calls) if calls and sound else None  # what is lost before it is no cut
            before, calls = place, calls + (record.kind in CALLS)
        raise AssertionError("a segment lacks the call that it was summed up with")


class _Chosen:
    """The records of one operator that a part keeps, behind what stands in for those that are left out."""

    def __init__(self, log: _Log, stop: Place | None) -> None:
        self.log = log
        self.before: Place | None = None
        """The last record left out at the beginning."""
        self.stop = stop
        """The first one that is left out again."""
        self.left_out = 0
        """Calls before those that are kept."""
        self._held: list[OrphanedMessage] = []
        self._told: set[tuple[str, Place]] = set()

    def begin(self, bound: int, start: int) -> None:
        """Sets the first record that is kept, see `_Log.left_out`."""
        self.before, self.left_out = self.log.left_out(bound, start) or (None, 0)

    def holds(self, place: Place) -> bool:
        """Returns whether the record at a place is kept."""
        return (self.before is None or place > self.before) and (self.stop is None or place < self.stop)

    def kept(self) -> Iterator[FiringRecord]:
        """The records that are kept, in order."""
        for record in self.log.read(self.before or START):
            place = (record.incarnation, record.index)
            if self.stop is not None and place >= self.stop:
                return
            if self.before is None or place > self.before:
                yield record

    @property
    def is_known(self) -> bool:
        """Returns whether a state of the operator is kept, or stands at the beginning."""
        return any(state.place == self.before or self.holds(state.place) for state in self.log.states)

    def told(self, stream: str, place: Place) -> None:
        """Notes a message whose record is kept, in case that a `cut` record accounts for it too."""
        if place in self.log.held.get(stream, ()):
            self._told.add((stream, place))

    def segments_apart(self) -> Iterator[tuple[int, _Segment]]:
        """The segments of which not all records are kept, by number."""
        segments = self.log.segments
        for number, segment in enumerate(segments):
            end = segments[number + 1].begin if number + 1 < len(segments) else None
            whole = self.stop is None or (end is not None and end <= self.stop)
            if not (whole and self.holds(segment.begin)):
                yield number, segment

    def sent(self, stream: str) -> tuple[Place, Place] | None:
        """The least and the largest place of what kept calls sent on a stream."""
        apart = dict(self.segments_apart())
        sent = [s.sent[stream] for n, s in enumerate(self.log.segments) if n not in apart and stream in s.sent]
        places = [place for each in sent for place in (each.first, each.last)]
        for number in self._ends(apart):
            for record in self.log.of_segment(number):
                if record.kind in CALLS and self.holds((record.incarnation, record.index)):
                    places += [
                        (record.incarnation, e.seq) for s, e in _emitted(record, self.log.streams) if s == stream
                    ]
        return (min(places), max(places)) if places else None

    def _ends(self, apart: Mapping[int, _Segment]) -> list[int]:
        """The segments of which a part is kept."""
        segments = self.log.segments
        found = []
        for number in apart:
            end = segments[number + 1].begin if number + 1 < len(segments) else None
            begins_before_stop = self.stop is None or segments[number].begin < self.stop
            if begins_before_stop and (self.before is None or end is None or self.before < end):
                found.append(number)
        return found

    def hold(self, stored: Collection[str], needed: Stamps, within: _Within) -> None:
        """Notes the messages that the part holds and whose records are not kept."""
        log = self.log
        extra = {s: {i: sorted(stamps) for i, stamps in needed.get(s, {}).items()} for s in log.streams if s in stored}

        def wanted(stream: str, incarnation: int, stamp: int) -> bool:
            return within(stream, stamp) or stamp in needed.get(stream, {}).get(incarnation, ())

        found = {(stream, place): held for stream in extra for place, held in log.held.get(stream, {}).items()}
        for stream in extra:
            for place, (record, held) in log.apart.get(stream, {}).items():
                found.pop((stream, place), None)  # of a `setup`: static, the first one is kept
                if record.kind != "setup" and not self.holds((record.incarnation, record.index)):
                    found[stream, place] = held
        for key in self._told:
            found.pop(key, None)
        for number, segment in self.segments_apart():
            if not any(_concerns(stream, sent, extra, within) for stream, sent in segment.sent.items()):
                continue
            for record in log.of_segment(number):
                if record.kind in CALLS and not self.holds((record.incarnation, record.index)):
                    for stream, made in _emitted(record, log.streams):
                        if stream in extra:
                            held = OrphanedMessage(stream, record.incarnation, made.seq, made.stamp, made.digest)
                            found[stream, held.place] = held
        kept = [h for h in found.values() if wanted(h.stream, h.incarnation, h.stamp)]
        self._held = sorted(kept, key=lambda held: (held.stream, held.place))

    def __iter__(self) -> Iterator[FiringRecord]:
        first = self.log.first
        if self.before is None:
            kept = self.kept()
            head = next(kept, first)
            yield from holding([] if head is None else _behind(head, kept), self._held)
            return
        before = next(self.log.read(self.before))
        if first is not None and first.kind == "setup" and (first.incarnation, first.index) != self.before:
            yield first
        at = bisect_right(self.log.parameters, self.before, key=lambda item: item[0])
        taken = _taken_up(self.log.parameters[at - 1][1] if at else UNCHANGED, before)
        yield cut_record(before, left_out=self.left_out, taken=taken, held=self._held, stamp=before.stamp)
        yield from holding(self.kept(), [])


class _Outside:
    """Finds the messages that records took and that no call made which is kept.

    `streams`: those that are looked at.
    """

    def __init__(self, chosen: Mapping[str, _Chosen], makers: Mapping[str, str], streams: Collection[str]) -> None:
        self._chosen, self._makers, self._streams = chosen, makers, streams
        self._inside: dict[str, tuple[Place, Place] | None] = {}
        self._wanted: dict[str, set[Place]] = {}

    def take(self, record: FiringRecord) -> None:
        """Notes what the call of a record took."""
        for stream, place in _taken(record):
            if stream not in self._streams:
                continue
            if stream not in self._inside:
                maker = self._chosen[self._makers[stream]]
                self._inside[stream] = None if stream in maker.log.scattered else maker.sent(stream)
                self._wanted[stream] = set()
            inside = self._inside[stream]
            if inside is None or not inside[0] <= place <= inside[1] or self._is_apart(stream, place):
                self._wanted[stream].add(place)

    def _is_apart(self, stream: str, place: Place) -> bool:
        log = self._chosen[self._makers[stream]].log
        return place in log.apart.get(stream, ()) or place in log.held.get(stream, ())

    def found(self) -> Iterator[tuple[str, OrphanedMessage]]:
        """The messages that are noted, by stream, as far as records account for them."""
        for stream, wanted in self._wanted.items():
            log = self._chosen[self._makers[stream]].log
            found = {place: held for place, held in log.held.get(stream, {}).items() if place in wanted}
            found |= {place: held for place, (_, held) in log.apart.get(stream, {}).items() if place in wanted}
            ordered = sorted(wanted)
            for number, segment in enumerate(log.segments):
                sent = segment.sent.get(stream)
                if sent is None or bisect_left(ordered, sent.first) == bisect_right(ordered, sent.last):
                    continue
                for record in log.of_segment(number):
                    for name, made in _emitted(record, log.streams):
                        place = (record.incarnation, made.seq)
                        if name == stream and record.kind in CALLS and place in wanted:
                            found[place] = OrphanedMessage(stream, *place, made.stamp, made.digest)
            yield from ((stream, held) for held in found.values())


def _concerns(stream: str, sent: _Sent, extra: Mapping[str, Mapping[int, Sequence[int]]], within: _Within) -> bool:
    """Returns whether a segment may have sent messages that the part holds."""
    return stream in extra and (
        within(stream, sent.low, sent.high)
        or any(bisect_left(stamps, sent.low) != bisect_right(stamps, sent.high) for stamps in extra[stream].values())
    )


def _emitted(record: FiringRecord, streams: Sequence[str]) -> Iterator[tuple[str, Any]]:
    for stream, emission in zip(streams, record.outputs, strict=False):  # a failed call has none
        if emission is not None and emission.seq != WITHHELD:
            yield stream, emission


def _taken(record: FiringRecord) -> Iterator[tuple[str, Place]]:
    for ref in record.inputs.values():
        for message in messages_of(ref):
            yield message.stream, (message.incarnation, message.seq)


def _behind(first: FiringRecord, others: Iterable[FiringRecord]) -> Iterator[FiringRecord]:
    yield first
    yield from others


def _changed(known: ResumePoint, record: FiringRecord, *, first: bool) -> ResumePoint:
    """The changed parameters of an operator behind a record, of those in front of it."""
    taken = taken_by(record)
    if record.kind == "setup" and not first:
        return ResumePoint(True, {**known.at_setup, **known.since}, {}, None, code_in(record))
    if record.kind == "param" and record.outcome == "ok":
        return known._replace(since={**known.since, record.detail["name"]: record.detail["value"]})
    return known if taken is None else taken._replace(state=None)


def _taken_up(parameters: ResumePoint, last: FiringRecord) -> ResumePoint:
    """Parameters, and the state behind the record `last`."""
    return parameters._replace(state=last.detail["state"] if is_known(last) else None)


def listed(records: Iterable[FiringRecord]) -> Read:
    """Reads records that are in memory."""
    known: dict[Place, FiringRecord] = {}
    for record in records:
        known.setdefault((record.incarnation, record.index), record)
    places = sorted(known)
    return lambda begin: (known[place] for place in places[bisect_left(places, begin) :])


def folded(records: Sequence[FiringRecord]) -> list[FiringRecord]:
    """The first record of an operator, and one that stands in for all others."""
    if not any(r.kind in CALLS or taken_by(r) is not None for r in records):
        return list(records)
    parameters = UNCHANGED
    for k, record in enumerate(records):
        parameters = _changed(parameters, record, first=not k)
    before, left_out = records[-1], sum(r.kind in CALLS for r in records)
    setup = [r for r in records[:1] if r.kind == "setup"]
    taken = _taken_up(parameters, before)
    return [*setup, cut_record(before, left_out=left_out, taken=taken, held=(), stamp=before.stamp)]
