"""What a flight recorder was given and when it kept what, and what must hold of that: it was asked where a condition of
its graph began to hold, and what it has kept is all that had come by then of the span that was asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dataflow.graph import Graph
from dataflow.messages import Diagnostics
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.records.firing import FiringRecord
from dataflow.sinks.flight_recorder import FlightSink
from simulation.world import Violation

STREAM, BELOW, DROPS = "left/slow", -8.0, 5.0
"""Conditions of the graph: the number on a stream is lower, an operator drops more messages a second."""
RECORDED = (
    f"keep: 200ms, after: 60ms, snapshots: 30ms, when: [raise, {{drops: {DROPS:g}}}, "
    f"{{stream: {STREAM}, field: vectors, below: {BELOW:g}}}]"
)
"""Fields of the graph's `record:`."""
Place = tuple[str, int, int]
"""Stream, incarnation and number of a message."""
Reason = tuple[str, str, int]
"""Kind of a reason, of whom it tells, and its stamp (ns)."""


@dataclass(slots=True)
class Flown:
    """What the last recorder of a run was given. `asked`: the reasons that it had to keep something, each with the
    newest stamp that had come (ns); `kept`: how many messages it had been given whenever it kept something, and which
    of them had a firing record by then."""

    given: list[tuple[Place, int]] = field(default_factory=list)
    told: set[Place] = field(default_factory=set)
    asked: list[tuple[Reason, int]] = field(default_factory=list)
    kept: list[tuple[int, frozenset[Place]]] = field(default_factory=list)
    clock: int = 0
    holding: set[str] = field(default_factory=set)

    def begins(self, name: str, holds: bool) -> bool:
        """Tells whether a condition holds that did not hold before."""
        before = name in self.holding
        (self.holding.add if holds else self.holding.discard)(name)
        return holds and not before


class Witness(FlightSink):
    """The flight recorder that ships; what it is given is noted."""

    def __init__(
        self, flown: Flown, folder: Path, graph: Graph, streams: list[str], options: Mapping[str, Any]
    ) -> None:
        flown.__init__()  # type: ignore[misc]  # of the recorder before it nothing is known
        self._flown = flown
        super().__init__(folder, graph, streams, options)

    def message(self, stream: str, message: Message, seq: int, incarnation: int) -> None:
        super().message(stream, message, seq, incarnation)
        flown = self._flown
        if not self.graph.streams[stream].static:
            flown.clock = max(flown.clock, message.stamp)
            flown.given.append(((stream, incarnation, seq), message.stamp))
        if stream == f"{self.graph.namespace}/{STREAM}":
            low = float(message.vectors[0, 0]) < BELOW  # type: ignore[attr-defined]
            if flown.begins(stream, low):
                flown.asked.append((("field", stream, message.stamp), flown.clock))

    def firings(self, operator: str, records: Sequence[FiringRecord], payload: bytes) -> None:
        super().firings(operator, records, payload)
        outputs = list(self.graph.nodes[operator].outputs.values())
        for record in records:
            for stream, made in zip(outputs, record.outputs, strict=False):  # a failed call has none
                if made is not None:
                    self._flown.told.add((stream, record.incarnation, made.seq))

    def event(self, name: str, stamp: int, data: Mapping[str, Any]) -> None:
        super().event(name, stamp, data)
        if name in ("trigger", "restart"):
            self._flown.asked.append(((name, ", ".join(data.get("operators", ())), stamp), self._flown.clock))

    def diagnostics(self, message: Diagnostics) -> None:
        super().diagnostics(message)
        owners = () if message.owners is None else message.owners
        for owner, key, value in zip(owners, message.keys, message.values, strict=True):
            if key == "drop_rate_hz" and self._flown.begins(message.names[owner], float(value) > DROPS):
                reason = "drops", message.names[owner], message.stamp
                self._flown.asked.append((reason, self._flown.clock))

    def _keep(self, *args: Any, **options: Any) -> None:
        self._flown.kept.append((len(self._flown.given), frozenset(self._flown.told)))
        super()._keep(*args, **options)


def check_reasons(flown: Flown, facts: Mapping[str, Any]) -> None:
    """Whenever a condition began to hold the recorder kept something for that reason, and for no other."""
    expected = [reason for reason, _ in flown.asked]
    told = [_reason(each) for one in facts["kept"] for each in one["reasons"]]
    if told != expected[: len(expected) - facts["not_kept"]]:
        raise Violation(f"the flight recorder was asked {expected} and kept {told}, {facts['not_kept']} not")


def check_spans(flown: Flown, graph: Graph, facts: Mapping[str, Any]) -> None:
    """What is kept has all messages of the span of its first reason that had come, and of which a record had come."""
    flight = graph.record.flight
    assert flight is not None
    number = 0
    for one, (given, told) in zip(facts["kept"], flown.kept, strict=True):
        clock = flown.asked[number][1]
        number += len(one["reasons"])
        if "error" in one:
            continue
        start, end = clock - flight.keep, clock + flight.after
        due = {place for place, stamp in flown.given[:given] if start <= stamp <= end and place in told}
        with Recording(Path(one["path"])) as recording:
            stored = {(m.stream, m.incarnation, m.seq) for m in recording.messages()}
        if lacking := sorted(due - stored):
            raise Violation(f"{Path(one['path']).name} lacks {len(lacking)} of {len(due)} messages: {lacking[:5]}")


def _reason(told: Mapping[str, Any]) -> Reason:
    """The reason that the recorder gives, in short."""
    if "stream" in told:
        return "field", told["stream"], told["stamp"]
    if "operator" in told:
        return "drops", told["operator"], told["stamp"]
    return "restart" if "operators" in told else "trigger", ", ".join(told.get("operators", ())), told["stamp"]
