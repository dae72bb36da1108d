"""Firings of a recorded run as spans of OpenTelemetry, in OTLP's JSON encoding: what trace viewers read.

A trace begins with a message of a source. The span of a firing is a child of that of the firing whose message it was
given on its first input that has one; messages on other inputs are links. Identifiers are digests of operator and
number, so that two exports of a recording are equal.
https://opentelemetry.io/docs/specs/otlp/#json-protobuf-encoding
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import xxhash

from dataflow.graph.model import Graph
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.sync import InputRef, MessageRef

KEPT = 16_384
"""Latest messages of a stream whose spans are known; an older one has none to be the parent."""
AT_ONCE = 512
_INTERNAL, _ERROR = 1, 2


class _Span(NamedTuple):
    trace: str
    span: str


class Spans:
    """Makes spans of firing records; `lines` yields requests of OTLP, one a line."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._of: dict[str, dict[tuple[int, int], _Span]] = {name: {} for name in graph.streams}

    def lines(self, records: Mapping[str, Iterable[FiringRecord]]) -> Iterator[str]:
        """Yields lines of spans, by the times at which calls began. `records`: each operator's, in order."""
        waiting: dict[str, list[dict[str, Any]]] = {}
        for record in heapq.merge(*records.values(), key=lambda each: each.wall_start):
            if record.kind in CALLS:
                mine = waiting.setdefault(record.operator, [])
                mine.append(self._span(record))
                if len(mine) == AT_ONCE:
                    yield self._line(record.operator, waiting.pop(record.operator))
        for operator, spans in waiting.items():
            yield self._line(operator, spans)

    def _span(self, record: FiringRecord) -> dict[str, Any]:
        name = f"{record.operator} {record.incarnation} {record.index}".encode()
        causes = [found for ref in record.inputs.values() if (found := self._cause(ref)) is not None]
        trace = causes[0].trace if causes else xxhash.xxh3_128_hexdigest(name)
        own = _Span(trace, xxhash.xxh3_64_hexdigest(name))
        self._note(record, own)
        parent = {"parentSpanId": causes[0].span} if causes else {}
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
                {"key": f"dataflow.{key}", "value": {"intValue": str(value)}}
                for key, value in (
                    ("stamp", record.stamp),
                    ("firing", record.index),
                    ("incarnation", record.incarnation),
                    ("dropped", len(record.drops)),
                )
            ],
            "links": [{"traceId": each.trace, "spanId": each.span} for each in dict.fromkeys(causes[1:])],
            **(failed if record.outcome == "error" else {}),
        }

    def _cause(self, ref: InputRef) -> _Span | None:
        """Returns the span in which the newest message of an input was made, as far as that is known."""
        if isinstance(ref, MessageRef):
            return self._of[ref.stream].get((ref.incarnation, ref.seq)) if ref.stream in self._of else None
        if isinstance(ref, tuple):
            made = (self._of.get(run.stream, {}).get((run.incarnation, run.last_seq)) for run in reversed(ref))
        else:
            made = (self._cause(each) for each in (ref or {}).values())
        return next((each for each in made if each is not None), None)

    def _note(self, record: FiringRecord, own: _Span) -> None:
        for stream, emission in zip(self._graph.nodes[record.operator].outputs.values(), record.outputs, strict=False):
            if emission is not None:
                kept = self._of[stream]
                kept[record.incarnation, emission.seq] = own
                if len(kept) > KEPT:
                    del kept[next(iter(kept))]

    def _line(self, operator: str, spans: list[dict[str, Any]]) -> str:
        about = {"service.name": operator, "service.namespace": self._graph.namespace}
        resource = {"attributes": [{"key": key, "value": {"stringValue": value}} for key, value in about.items()]}
        scope = {"scope": {"name": "robot-dataflow"}, "spans": spans}
        return json.dumps({"resourceSpans": [{"resource": resource, "scopeSpans": [scope]}]}, separators=(",", ":"))
