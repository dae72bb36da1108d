"""Firings of a run as spans of OpenTelemetry, in OTLP's JSON encoding: what trace viewers read.

A trace begins with a message of a source. The span of a firing is a child of that of the firing whose message it was
given on its first input that has one; messages on other inputs are links. Identifiers are digests of operator and
number, so that two exports of a recording are equal.
https://opentelemetry.io/docs/specs/otlp/#json-protobuf-encoding
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Set
from typing import Any, NamedTuple

import xxhash

from dataflow.graph.model import Graph
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.sync import InputRef, MessageRef

KEPT = 16_384
"""Latest messages of a stream whose spans are known; an older one has none to be the parent."""
AT_ONCE = 512
_INTERNAL, _ERROR = 1, 2
_Place = tuple[int, int]
"""Incarnation and number of a message."""


class _Span(NamedTuple):
    trace: str
    span: str


class Line(NamedTuple):
    """A request of OTLP as text, and how many spans it holds."""

    text: str
    spans: int


class Spans:
    """Makes spans of firing records: of a whole recording by `lines`, of a graph that runs by `round` and `rest`.

    Spans of a whole recording have the number of the call and how many messages were dropped before it.
    """

    def __init__(self, graph: Graph, *, whole: bool = True) -> None:
        self._graph, self._whole = graph, whole
        self._held: dict[str, list[FiringRecord]] = {}
        """Records of the last round."""
        self._of: dict[str, dict[_Place, _Span]] = {name: {} for name in graph.streams}
        self._calls = Counter[str]()
        self._passed: dict[str, _Place] = {}
        """Each stream's latest message that a record has come to."""

    def lines(self, records: Mapping[str, Iterable[FiringRecord]]) -> Iterator[Line]:
        """Yields lines of spans, by the times at which calls began; a call comes behind those whose messages it was
        given, by whichever clock they have their times. `records`: each operator's, in order."""
        return self._lines(self._in_order(records))

    def round(self, records: Mapping[str, Iterable[FiringRecord]]) -> Iterator[Line]:
        """Yields lines of the records of the round before, and of those of this one that caused them: the process of a
        cause may have been asked earlier than that of its effect. `records`: each operator's since then, in order."""
        return self._lines(self._due(records))

    def rest(self) -> Iterator[Line]:
        """Yields lines of the last round."""
        held, self._held = self._held, {}
        return self.lines(held)

    def _due(self, records: Mapping[str, Iterable[FiringRecord]]) -> Iterator[FiringRecord]:
        due = {name: len(each) for name, each in self._held.items() if each}
        left = {name: [*self._held.get(name, ()), *records.get(name, ())] for name in {**self._held, **records}}
        taken = Counter[str]()
        if due:
            for record in self._in_order(left):
                yield record
                taken[record.operator] += 1
                if taken[record.operator] >= due.get(record.operator, 0):
                    due.pop(record.operator, None)
                if not due:
                    break
        self._held = {name: each[taken[name] :] for name, each in left.items()}

    def _lines(self, records: Iterable[FiringRecord]) -> Iterator[Line]:
        waiting: dict[str, list[dict[str, Any]]] = {}
        for record in records:
            if record.kind in CALLS:
                mine = waiting.setdefault(record.operator, [])
                mine.append(self._span(record))
                if len(mine) == AT_ONCE:
                    yield self._line(record.operator, waiting.pop(record.operator))
        for operator, spans in waiting.items():
            yield self._line(operator, spans)

    def _in_order(self, records: Mapping[str, Iterable[FiringRecord]]) -> Iterator[FiringRecord]:
        """Yields all records by the times at which calls began, each behind the messages that it was given."""
        left = {name: iter(each) for name, each in records.items()}
        heads: list[tuple[int, str, FiringRecord]] = []
        held: dict[str, list[tuple[int, str, FiringRecord]]] = {}  # by the maker that is behind

        def read(name: str) -> None:
            if (record := next(left[name], None)) is None:
                del left[name]
            else:
                heapq.heappush(heads, (record.wall_start, name, record))

        for name in records:
            read(name)
        while heads or held:
            if lost := not heads:  # they wait for each other's messages, whose records are lost
                heads, held = sorted(head for each in held.values() for head in each), {}
            head = heapq.heappop(heads)
            _, name, record = head
            maker = None if lost else self._behind(record, left.keys() - {name})
            if maker is not None:
                held.setdefault(maker, []).append(head)
                continue
            yield record
            read(name)
            for each in held.pop(name, ()):
                heapq.heappush(heads, each)

    def _behind(self, record: FiringRecord, makers: Set[str]) -> str | None:
        """Returns one of `makers` whose records have not come to a message that a call was given; None where all
        have."""
        for ref in record.inputs.values():
            for stream, place in _places(ref):
                made = self._graph.streams.get(stream)
                if made is not None and made.node in makers and self._passed.get(stream, (-1, -1)) < place:
                    return made.node
        return None

    def _span(self, record: FiringRecord) -> dict[str, Any]:
        name = f"{record.operator} {record.incarnation} {record.index}".encode()
        number = self._calls[record.operator]
        self._calls[record.operator] += 1
        causes = [found for ref in record.inputs.values() if (found := self._cause(ref)) is not None]
        trace = causes[0].trace if causes else xxhash.xxh3_128_hexdigest(name)
        own = _Span(trace, xxhash.xxh3_64_hexdigest(name))
        self._note(record, own)
        parent = {"parentSpanId": causes[0].span} if causes else {}
        about = {"stamp": record.stamp, "call": number, "incarnation": record.incarnation, "dropped": len(record.drops)}
        if not self._whole:
            del about["call"], about["dropped"]
        failed = {"status": {"code": _ERROR, "message": str(record.detail.get("error", ""))}}
        return {
            "traceId": own.trace,
            "spanId": own.span,
            **parent,
            "name": f"{record.operator} {record.kind}",
            "kind": _INTERNAL,
            "startTimeUnixNano": str(record.wall_start),
            "endTimeUnixNano": str(record.wall_start + record.duration),
            "attributes": [
                {"key": f"dataflow.{key}", "value": {"intValue": str(value)}} for key, value in about.items()
            ],
            "links": [{"traceId": each.trace, "spanId": each.span} for each in dict.fromkeys(causes[1:])],
            **(failed if record.outcome == "error" else {}),
        }

    def _cause(self, ref: InputRef) -> _Span | None:
        """Returns the span in which the newest message of an input was made, as far as that is known."""
        return next((made for stream, place in _places(ref) if (made := self._of.get(stream, {}).get(place))), None)

    def _note(self, record: FiringRecord, own: _Span) -> None:
        for stream, emission in zip(self._graph.nodes[record.operator].outputs.values(), record.outputs, strict=False):
            if emission is not None:
                kept, place = self._of[stream], (record.incarnation, emission.seq)
                kept[place], self._passed[stream] = own, place
                if len(kept) > KEPT:
                    del kept[next(iter(kept))]

    def _line(self, operator: str, spans: list[dict[str, Any]]) -> Line:
        about = {"service.name": operator, "service.namespace": self._graph.namespace}
        resource = {"attributes": [{"key": key, "value": {"stringValue": value}} for key, value in about.items()]}
        scope = {"scope": {"name": "robot-dataflow"}, "spans": spans}
        request = {"resourceSpans": [{"resource": resource, "scopeSpans": [scope]}]}
        return Line(json.dumps(request, separators=(",", ":")), len(spans))


def _places(ref: InputRef) -> Iterator[tuple[str, _Place]]:
    """Yields streams and places of the newest messages of an input, the one that counts as its cause first."""
    if isinstance(ref, MessageRef):
        yield ref.stream, (ref.incarnation, ref.seq)
    elif isinstance(ref, tuple):
        yield from ((run.stream, (run.incarnation, run.last_seq)) for run in reversed(ref))
    else:
        for each in (ref or {}).values():
            yield from _places(each)
