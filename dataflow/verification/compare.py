"""Compares what operators make now with the recorded messages themselves, field by field, while it is made."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.recording.streams.diff import FieldDifference, differences
from dataflow.records.comparison import Verification
from dataflow.records.firing import Emission, FiringRecord
from dataflow.reexecution.recorded_run import recorded_message
from dataflow.sync import Entry

NOT_STORED = "the recording does not hold this message"


@dataclass(frozen=True, slots=True)
class OutputDifference:
    """One message that differs from the recorded one.

    `index`, `kind` and `firing`: of the firing record, and its stamp; `call`: its number among the operator's calls,
    once they were counted. `seq`, `incarnation`: the place in the stream.
    `fields` are the fields that differ (beyond the tolerance, where there is one): empty, with the reason in `note`,
    where the recorded message is unavailable.
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
    call: int | None = None

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"fields": [f.as_json() for f in self.fields]}

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> OutputDifference:
        """Restores a difference from the values of `asdict` after an encoding without tuples."""
        fields = tuple(
            FieldDifference(**{**f, "index": None if f["index"] is None else tuple(f["index"])})
            for f in values["fields"]
        )
        return OutputDifference(**{**values, "fields": fields})


@dataclass(slots=True)
class OutputComparison:
    """The comparison of one operator's messages with the recorded ones.

    `equal` have the recorded digest, `within` differ by no more than the tolerance, `beyond` by more or in what no
    tolerance applies to; without a tolerance, all that differ are beyond it. `unpaired` counts what is no pair of
    messages: nothing where there was a message, a message where there was nothing, an error. `unverifiable` firings
    could not be made. `own`: the first difference came while all that the operator had been given was as recorded.
    `first` are the outputs of the first firing that differs beyond the tolerance.
    """

    operator: str
    equal: int = 0
    within: int = 0
    beyond: int = 0
    unpaired: int = 0
    unverifiable: int = 0
    own: bool = True
    max_difference: float = 0.0
    first: list[OutputDifference] = field(default_factory=list)

    @property
    def tolerated(self) -> bool:
        """Every output is there and lies within the tolerance."""
        return not (self.beyond or self.unpaired or self.unverifiable)

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"first": [d.as_json() for d in self.first], "tolerated": self.tolerated}

    @staticmethod
    def from_wire(values: Mapping[str, Any]) -> OutputComparison:
        return OutputComparison(**{**values, "first": [OutputDifference.from_wire(d) for d in values["first"]]})


class Comparer:
    """Compares messages as they are made, by digest; those that differ field by field, where that is of use.

    That is with a `tolerance`, and else for the first firing of an operator that differs: the recorded message is then
    looked up in the file.
    """

    def __init__(
        self,
        recording: Recording,
        graph: Graph,
        operators: Collection[str],
        tolerance: float | None,
        repeated: Callable[[str], FiringRecord | None],
    ) -> None:
        """`repeated` returns the record by which an operator is being repeated now."""
        self._recording, self._graph, self._tolerance, self._repeated = recording, graph, tolerance, repeated
        self.found = {name: OutputComparison(name) for name in operators}

    def made(self, stream: str, entry: Entry) -> None:
        """Takes a message that an operator has made under the number of a recorded one."""
        comparison = self.found[self._graph.streams[stream].node]
        record, expected = self._expected(comparison.operator, stream)
        if expected.digest == entry.digest:
            comparison.equal += 1
            return
        if self._tolerance is None and comparison.first and not _is_of_the_first(comparison, record):
            comparison.beyond += 1
            return
        recorded = recorded_message(self._recording, stream, (entry.incarnation, entry.seq), expected.stamp)
        fields: Sequence[FieldDifference] = ()
        if recorded is not None:
            fields, largest = differences(recorded, entry.value, self._tolerance)
            comparison.max_difference = max(comparison.max_difference, largest)
            if self._tolerance is not None and not fields:
                comparison.within += 1
                return
        comparison.beyond += 1
        if comparison.first and not _is_of_the_first(comparison, record):
            return
        ports = self._graph.nodes[comparison.operator].outputs
        comparison.first.append(
            OutputDifference(
                stream=stream,
                port=next(port for port, name in ports.items() if name == stream),
                index=record.index,
                kind=record.kind,
                firing=record.stamp,
                seq=entry.seq,
                incarnation=entry.incarnation,
                recorded=expected.digest.hex(),
                here=entry.digest.hex(),
                fields=tuple(fields),
                note="" if recorded is not None else NOT_STORED,
            )
        )

    def close(self, results: Mapping[str, Verification]) -> Mapping[str, OutputComparison]:
        """The comparisons of the operators that differ, with what their verifications know."""
        for name, comparison in self.found.items():
            result = results[name]
            comparison.unpaired = result.differing - result.states - comparison.within - comparison.beyond
            comparison.unverifiable = result.unverifiable + result.lost_records
            comparison.own = result.first is None or result.own_fault
        return {name: found for name, found in self.found.items() if results[name].first is not None}

    def _expected(self, operator: str, stream: str) -> tuple[FiringRecord, Emission]:
        """The record that is being repeated, and its output on a stream."""
        record = self._repeated(operator)
        port = list(self._graph.nodes[operator].outputs.values()).index(stream)
        emission = None if record is None else record.outputs[port]
        assert record is not None
        assert emission is not None
        return record, emission


def _is_of_the_first(comparison: OutputComparison, record: FiringRecord) -> bool:
    first = comparison.first[0]
    return (first.incarnation, first.index) == (record.incarnation, record.index)
