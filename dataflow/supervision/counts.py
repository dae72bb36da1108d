"""Counts what operators have done so far, from what their processes report: counts, drops by reason, waits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from dataflow.supervision.part import Part
from dataflow.supervision.report import OperatorCounts
from dataflow.supervision.run_state import RunState
from dataflow.supervision.supervised import Supervised

MISSED = "missed"
"""The reason of messages that were lost on their way to a process that did not take them."""
_NOTHING: Counter[tuple[str, str]] = Counter()


class Counts(Part):
    """Keeps the status. A process that was started again counts from nothing; what came before is added."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._base: dict[str, OperatorCounts] = {}
        self._base_drops: dict[str, Counter[tuple[str, str]]] = {}
        self._reported: dict[str, OperatorCounts] = {}
        self._base_waits: dict[str, Counter[tuple[str, str]]] = {}
        self._reported_waits: dict[str, Counter[tuple[str, str]]] = {}
        self._reported_drops: dict[str, Counter[tuple[str, str]]] = {}
        self._missed: dict[str, Counter[tuple[str, str]]] = {}

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        match kind:
            case "progress":
                self._take(fields)
            case "ended":
                self._take(fields["report"])
            case "gap":
                self._miss(process, fields["stream"], fields["following"] - fields["first"])

    def _take(self, fields: Mapping[str, Any]) -> None:
        counts, drops, waits = fields["counts"], fields.get("drops", {}), fields.get("waits", {})
        if (first := fields.get("first")) is not None:
            self.run.status.began = min(first, self.run.status.began or first)
        for name, values in counts.items():
            self._reported[name] = OperatorCounts(*values)
        for name, found in drops.items():
            self._reported_drops[name] = Counter({(input_name, why): n for input_name, why, n in found})
        for name, found in waits.items():
            self._reported_waits[name] = Counter({(input_name, what): n for input_name, what, n in found})
        for name in dict.fromkeys((*counts, *drops, *waits)):
            self._update(name)

    def _miss(self, process: Supervised, stream: str, number: int) -> None:
        """Counts messages of a stream that did not reach a process against the inputs that would have taken them."""
        takers = [
            (name, input_name)
            for name in process.nodes
            for input_name, streams in self.run.graph.nodes[name].inputs.items()
            if stream in streams
        ]
        for name, input_name in takers or [(process.label, stream)]:
            self._missed.setdefault(name, Counter())[input_name, MISSED] += max(0, number)
            self._update(name)

    def _update(self, name: str) -> None:
        status = self.run.status
        missed = self._missed.get(name)
        counts = self._reported.get(name) or OperatorCounts()
        if (base := self._base.get(name)) is not None:
            counts = counts.after(base)
        status.operators[name] = counts if not missed else counts.after(OperatorCounts(dropped=missed.total()))
        if drops := _sum(self._reported_drops.get(name), self._base_drops.get(name), missed):
            status.drops[name] = drops
        if waits := _sum(self._reported_waits.get(name), self._base_waits.get(name)):
            status.waits[name] = waits

    def away(self, process: Supervised) -> None:
        for name in process.nodes:
            if (reported := self._reported.pop(name, None)) is not None:
                self._base[name] = reported.after(self._base.get(name, OperatorCounts()))
            self._base_drops[name] = self._base_drops.get(name, Counter()) + self._reported_drops.pop(name, Counter())
            self._base_waits[name] = self._base_waits.get(name, Counter()) + self._reported_waits.pop(name, Counter())


def _sum(*counters: Counter[tuple[str, str]] | None) -> Counter[tuple[str, str]]:
    """Adds what there is; mostly that is nothing, and then no counter is made of it."""
    found = _NOTHING
    for counter in counters:
        if counter:
            found = found + counter
    return found
