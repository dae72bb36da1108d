"""Compares what operators make now with the recorded messages themselves, field by field.

Every operator is given the recorded inputs, where they were recorded: a difference is its own, and none is handed on.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dataflow.graph.model import Graph
from dataflow.messages.base import Message
from dataflow.recording import Recording
from dataflow.recording.diff import FieldDifference, differences
from dataflow.records.firing import FiringRecord
from dataflow.reexecution.engine import Recomputation, plan_feeding
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sync import Entry
from dataflow.verification.worker import Tell, apart

NOT_STORED = "the recording does not hold this message"


@dataclass(frozen=True, slots=True)
class OutputDifference:
    """One message that came out otherwise than recorded.

    `index`, `kind` and `firing`: of the firing record and its stamp; `seq`, `incarnation`: the place in the stream.
    `fields` are the fields that differ (beyond the tolerance, where there is one): empty, with the reason in `note`,
    where the recorded message is not to be had.
    """

    stream: str
    port: str
    index: int
    kind: str
    firing: int
    seq: int
    incarnation: int
    recorded: str
    here: str
    fields: tuple[FieldDifference, ...] = ()
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"fields": [f.as_json() for f in self.fields]}

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> OutputDifference:
        """From the values of `asdict` after a way that knows only lists."""
        fields = tuple(
            FieldDifference(**{**f, "index": None if f["index"] is None else tuple(f["index"])})
            for f in values["fields"]
        )
        return OutputDifference(**{**values, "fields": fields})


@dataclass(slots=True)
class OutputComparison:
    """How the messages of one operator compare with the recorded ones.

    `equal` have the recorded digest, `within` differ by no more than the tolerance, `beyond` by more or in what no
    tolerance applies to. `otherwise` counts what is no pair of messages: nothing where there was a message, a message
    where there was nothing, an error. `unverifiable` firings could not be made. `own`: the first difference came while
    all that the operator had been given was as recorded. `first` are the outputs of the first
    firing that differs beyond the tolerance. `got` is the digest of the first that differs at all, in firing `index`.
    `note` says why nothing was compared.
    """

    operator: str
    equal: int = 0
    within: int = 0
    beyond: int = 0
    otherwise: int = 0
    unverifiable: int = 0
    own: bool = True
    max_difference: float = 0.0
    first: list[OutputDifference] = field(default_factory=list)
    index: int | None = None
    got: str = ""
    note: str = ""

    @property
    def tolerated(self) -> bool:
        """Every output is there and lies within the tolerance."""
        return not (self.beyond or self.otherwise or self.unverifiable or self.note)

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"first": [d.as_json() for d in self.first], "tolerated": self.tolerated}

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> OutputComparison:
        return OutputComparison(**{**values, "first": [OutputDifference.from_wire(d) for d in values["first"]]})


def compare_outputs(
    path: Path,
    graph: Graph,
    operators: Collection[str],
    *,
    tolerance: float | None = None,
    told: Tell | None = None,
    stall_timeout: float = 120.0,
) -> dict[str, OutputComparison]:
    """Runs operators again, by their records, and compares their messages with the recorded ones.

    Without `tolerance` only until each has made a firing that differs. In a process of its own. Operators that cannot
    be given what they took have a `note` instead. Raises `RunFailed`.
    """
    request = {
        "path": str(path),
        "graph": graph.to_json(),
        "operators": sorted(operators),
        "tolerance": tolerance,
    }
    found = apart(f"{__name__}:answer", request, threads=graph.threads, told=told, stall_timeout=stall_timeout)
    return {name: OutputComparison.from_wire(values) for name, values in found.items()}


def answer(request: Mapping[str, Any], tell: Tell) -> dict[str, Any]:
    """`compare_outputs`, in the process that does it."""
    graph = Graph.from_json(request["graph"])
    with Recording(request["path"]) as recording:
        able, found = [], {}
        for name in request["operators"]:
            try:
                plan_feeding(recording, graph, [name])
            except ReplayError as error:
                found[name] = OutputComparison(name, note=str(error))
            else:
                able.append(name)
        if able:
            found |= _Comparer(recording, graph, able, request["tolerance"]).run(tell)
        return {name: asdict(comparison) for name, comparison in found.items()}


@dataclass(frozen=True, slots=True)
class _Expected:
    record: FiringRecord
    port: str
    stamp: int
    digest: bytes


class _Comparer:
    def __init__(self, recording: Recording, graph: Graph, operators: Collection[str], tolerance: float | None) -> None:
        self.recording, self.graph, self.tolerance = recording, graph, tolerance
        self.found = {name: OutputComparison(name) for name in operators}
        feeding = plan_feeding(recording, graph, operators)
        self.work = Recomputation(recording, graph, feeding, made=self._made)
        self._expected = {name: self._emissions(name) for name in operators}
        self._firings = 0

    def _emissions(self, operator: str) -> dict[tuple[str, int, int], _Expected]:
        """Stream, incarnation, seq → what was emitted there."""
        ports = self.graph.nodes[operator].outputs
        return {
            (ports[port], record.incarnation, emission.seq): _Expected(record, port, emission.stamp, emission.digest)
            for record in self.work.records[operator]
            for port, emission in zip(ports, record.outputs, strict=False)
            if emission is not None
        }

    def run(self, tell: Tell) -> Mapping[str, OutputComparison]:
        results = self.work.run(until=self._until(tell))
        for name, comparison in self.found.items():
            result = results[name]
            comparison.otherwise = result.differing - result.states - comparison.within - comparison.beyond
            comparison.unverifiable = result.unverifiable + result.lost_records
            comparison.own = result.first is None or result.own_fault
            if result.first is not None:
                comparison.index, comparison.got = result.first.index, result.first.got
        return self.found

    def _until(self, tell: Tell) -> Callable[[], bool]:
        results = self.work.results()

        def enough() -> bool:
            tell({"firings": {name: runner.firings for name, runner in self.work.runners.items()}})
            return self.tolerance is None and all(results[name].first is not None for name in self.found)

        return enough

    def _made(self, stream: str, entry: Entry) -> None:
        comparison = self.found.get(self.graph.streams[stream].node)
        if comparison is None:
            return
        expected = self._expected[comparison.operator].get((stream, entry.incarnation, entry.seq))
        if expected is None:
            return
        if expected.digest == entry.digest:
            comparison.equal += 1
            return
        recorded = self._recorded(stream, expected.stamp, entry)
        fields: list[FieldDifference] = []
        if recorded is not None:
            fields, largest = differences(recorded, entry.value, self.tolerance)
            comparison.max_difference = max(comparison.max_difference, largest)
            if not fields:
                comparison.within += 1
                return
        comparison.beyond += 1
        place = (entry.incarnation, expected.record.index)
        if not comparison.first or (comparison.first[0].incarnation, comparison.first[0].index) == place:
            comparison.first.append(
                OutputDifference(
                    stream=stream,
                    port=expected.port,
                    index=expected.record.index,
                    kind=expected.record.kind,
                    firing=expected.record.stamp,
                    seq=entry.seq,
                    incarnation=entry.incarnation,
                    recorded=expected.digest.hex(),
                    here=entry.digest.hex(),
                    fields=tuple(fields),
                    note="" if recorded is not None else NOT_STORED,
                )
            )

    def _recorded(self, stream: str, stamp: int, entry: Entry) -> Message | None:
        info = self.recording.streams.get(stream)
        if info is None or info.message_type is None:
            return None
        for found in self.recording.messages([stream], start=stamp, end=stamp):
            if (found.incarnation, found.seq) == (entry.incarnation, entry.seq):
                return found.message
        return None
