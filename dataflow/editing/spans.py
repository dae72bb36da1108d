"""Firing records of a span of a recorded run, and the messages that its firings need from beyond it.

Every operator is taken up after its last recorded state at or before the span, and repeated from there. So the part
holds, besides the span, what its firings took before it. An operator without a recorded state begins with the span.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dataflow.editing.joins import holding
from dataflow.records.cuts import Held, Taken, cut_record, held_by, is_known, taken_by
from dataflow.records.firing import CALLS, WITHHELD, FiringRecord
from dataflow.records.reading import whole
from dataflow.sync import messages_of

Place = tuple[int, int]
Stamps = Mapping[str, Mapping[int, Collection[int]]]
"""Stream → incarnation → stamps."""
Span = tuple[int | None, int | None]
"""The first and the last stamp (ns; None: not cut there)."""
Within = Callable[[str, int], bool]
"""Returns whether a stamp of a stream lies within the span."""


@dataclass(frozen=True, slots=True)
class SpanRecords:
    """The firing records of a span, by operator, and what they need.

    `needed`: messages outside of the span that they took or made. `unknown`: operators whose calls before the span were
    left out and that gave no state by then: they verify only where they have none. `lead`: the stamp from which
    operators are repeated (ns), where that is before the span.
    """

    records: Mapping[str, Sequence[FiringRecord]]
    needed: Stamps
    unknown: tuple[str, ...]
    lead: int | None


@dataclass(slots=True)
class _Made:
    """A message by the record of its maker. `index`: that record's place in the list of its operator."""

    held: Held
    index: int


@dataclass(slots=True)
class _Operator:
    """One operator: its records in order, the place of the first one kept, and that of the first one left out again."""

    records: list[FiringRecord]
    streams: tuple[str, ...]
    first: int = 0
    end: int = 0
    made: dict[str, dict[Place, _Made]] = field(default_factory=dict)

    @property
    def kept(self) -> list[FiringRecord]:
        return self.records[self.first : self.end]

    @property
    def left_out(self) -> int:
        """Calls before those that are kept."""
        return sum(r.kind in CALLS for r in self.records[: self.first])


class RunRecords:
    """The firing records of a run in memory, of which those of spans are chosen.

    `log`: the records of each operator; `outputs`: its streams in the order of its ports.
    """

    def __init__(self, log: Mapping[str, Iterable[FiringRecord]], outputs: Mapping[str, Sequence[str]]) -> None:
        self._operators = {name: _operator(records, tuple(outputs.get(name, ()))) for name, records in log.items()}
        self._makers = {stream: name for name, streams in outputs.items() for stream in streams}

    def of_span(
        self, stored: Collection[str], start: int | None, end: int | None, span: Callable[[str], Span]
    ) -> SpanRecords:
        """Chooses the records of the span from `start` to `end` (ns, inclusive; None: not cut there).

        `stored`: the streams that the recording holds. Other streams are made again, so their producers are repeated
        from where it is needed. `span`: that from which the messages of a stream are taken over.
        """

        def within(stream: str, stamp: int) -> bool:
            low, high = span(stream)
            return (low is None or stamp >= low) and (high is None or stamp <= high)

        operators = self._operators
        for operator in operators.values():
            operator.first, operator.end = 0, _end(operator.records, end)
        if start is not None:
            self._choose_first(stored, start)
        needed = _needed(operators, self._makers, within)
        records: dict[str, list[FiringRecord]] = {}
        unknown: list[str] = []
        for name, operator in operators.items():
            held = _held(operator, stored, needed, within)
            records[name] = _with_cut(operator, held)
            if operator.left_out and not any(map(_takes_up, records[name])):
                unknown.append(name)
        lead = min(
            (r.stamp for o in operators.values() if o.left_out for r in o.kept if r.kind in CALLS),
            default=None,
        )
        before = lead if lead is not None and start is not None and lead < start else None
        return SpanRecords(records, needed, tuple(sorted(unknown)), before)

    def _choose_first(self, stored: Collection[str], start: int) -> None:
        """Sets the first record that is kept of each operator."""
        operators = self._operators
        bounds = dict.fromkeys(operators, start - 1)  # a state at `start` has seen what lies there
        moved = list(operators)
        while moved:
            name = moved.pop()
            operator = operators[name]
            operator.first = _first_kept(operator.records, bounds[name], start)
            for stream, place in _taken(operator.kept):
                maker = self._makers.get(stream, "")
                made = operators[maker].made.get(stream, {}).get(place) if maker in operators else None
                if made is None or stream in stored or made.index >= operators[maker].first:
                    continue
                if made.held.stamp - 1 < bounds[maker]:
                    bounds[maker] = made.held.stamp - 1
                    moved.append(maker)


def _operator(records: Iterable[FiringRecord], streams: tuple[str, ...]) -> _Operator:
    ordered: dict[tuple[int, int], FiringRecord] = {}
    for record in records:
        ordered.setdefault((record.incarnation, record.index), record)
    listed = [ordered[place] for place in sorted(ordered)]
    made: dict[str, dict[Place, _Made]] = {stream: {} for stream in streams}
    for k, record in enumerate(listed):
        for stream, emission in zip(streams, record.outputs, strict=False):
            if emission is not None and emission.seq != WITHHELD:
                held = Held(stream, record.incarnation, emission.seq, emission.stamp, emission.digest)
                made[stream][held.place] = _Made(held, k)
        for held in held_by(record):
            if held.stream in made:
                made[held.stream].setdefault(held.place, _Made(held, -1))
    return _Operator(listed, streams, made=made)


def _end(records: Sequence[FiringRecord], end: int | None) -> int:
    """The place of the first record that is left out again."""
    if end is None:
        return len(records)
    return next((k for k, r in enumerate(records) if r.kind in CALLS and r.stamp > end), len(records))


def _first_kept(records: Sequence[FiringRecord], bound: int, start: int) -> int:
    """The place of the first record to keep: after the last state at or before `bound`, else the first call from
    `start` on; 0 where no call lies before it."""
    known, _ = whole(records)
    sound = {(r.incarnation, r.index) for r in known}
    states = [k for k, r in enumerate(records) if is_known(r) and r.stamp <= bound]
    place = next((k + 1 for k in reversed(states) if (records[k].incarnation, records[k].index) in sound), None)
    if place is None:
        place = next((k for k, r in enumerate(records) if r.kind in CALLS and r.stamp >= start), len(records))
        if place < len(records) and (records[place].incarnation, records[place].index) not in sound:
            return 0  # what is lost before it is no cut
    return place if any(r.kind in CALLS for r in records[:place]) else 0


def _taken(records: Iterable[FiringRecord]) -> Iterable[tuple[str, Place]]:
    for record in records:
        for ref in record.inputs.values():
            for message in messages_of(ref):
                yield message.stream, (message.incarnation, message.seq)


def _needed(
    operators: Mapping[str, _Operator], makers: Mapping[str, str], within: Within
) -> dict[str, dict[int, set[int]]]:
    """The stamps of messages outside of the span that kept calls took or made."""
    needed: dict[str, dict[int, set[int]]] = {}

    def note(held: Held) -> None:
        if not within(held.stream, held.stamp):
            needed.setdefault(held.stream, {}).setdefault(held.incarnation, set()).add(held.stamp)

    for operator in operators.values():
        for stream, place in _taken(operator.kept):
            maker = operators.get(makers.get(stream, ""))
            if maker is not None and (made := maker.made.get(stream, {}).get(place)) is not None:
                note(made.held)
        for found in operator.made.values():
            for made in found.values():
                if operator.first <= made.index < operator.end and operator.records[made.index].kind in CALLS:
                    note(made.held)
    return needed


def _held(operator: _Operator, stored: Collection[str], needed: Stamps, within: Within) -> list[Held]:
    """Messages that the part holds and whose records are not kept."""
    found = []
    for stream in operator.streams:
        if stream not in stored:
            continue
        extra = needed.get(stream, {})
        for made in operator.made[stream].values():
            held = made.held
            if operator.first <= made.index < operator.end:
                continue
            if made.index >= 0 and operator.records[made.index].kind == "setup":
                continue  # static: the first one is kept
            if within(held.stream, held.stamp) or held.stamp in extra.get(held.incarnation, ()):
                found.append(held)
    return sorted(found, key=lambda held: (held.stream, held.place))


def _with_cut(operator: _Operator, held: list[Held]) -> list[FiringRecord]:
    """The records of one operator with what stands in for those left out."""
    records, kept = operator.records, list(operator.kept)
    if operator.first:
        before = records[operator.first - 1]
        kept = holding(kept, [])
        cut = cut_record(before, left_out=operator.left_out, taken=_taken_up(operator), held=held, stamp=before.stamp)
        setup = [r for r in records[:1] if r.kind == "setup" and r is not before]
        return [*setup, cut, *kept]
    return holding(kept or records[:1], held)


def folded(records: Sequence[FiringRecord]) -> list[FiringRecord]:
    """The first record of an operator, and one that stands in for all others."""
    if not any(r.kind in CALLS or taken_by(r) is not None for r in records):
        return list(records)
    operator = _Operator(list(records), (), first=len(records), end=len(records))
    before = records[-1]
    setup = [r for r in records[:1] if r.kind == "setup"]
    taken = _taken_up(operator)
    return [*setup, cut_record(before, left_out=operator.left_out, taken=taken, held=(), stamp=before.stamp)]


def _taken_up(operator: _Operator) -> Taken:
    """Parameters and state at the first record that is kept."""
    at_setup: dict[str, Any] = {}
    since: dict[str, Any] = {}
    again = False
    for k, record in enumerate(operator.records[: operator.first]):
        taken = taken_by(record)
        if record.kind == "setup" and k:
            at_setup, since, again = at_setup | since, {}, True
        elif record.kind == "param" and record.outcome == "ok":
            since[record.detail["name"]] = record.detail["value"]
        elif taken is not None:
            at_setup, since, again = dict(taken.at_setup), dict(taken.since), taken.again
    last = operator.records[operator.first - 1]
    return Taken(again, at_setup, since, last.detail["state"] if is_known(last) else None)


def _takes_up(record: FiringRecord) -> bool:
    return is_known(record) or (taken_by(record) is not None and "state" in record.detail)
