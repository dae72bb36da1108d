"""Counts what operators have done so far, from what their processes report: counts, drops by reason, waits."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dataflow.supervision.core.report import OperatorCounts
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised
from dataflow.supervision.core.watchers.watcher import Watcher

MISSED = "missed"
"""The reason of messages that were lost on their way to a process that did not take them."""


@dataclass(slots=True)
class _Tally:
    """The counts of one operator; drops by input and reason, waits by input and kind."""

    counts: OperatorCounts = field(default_factory=OperatorCounts)
    drops: Counter[tuple[str, str]] = field(default_factory=Counter)
    waits: Counter[tuple[str, str]] = field(default_factory=Counter)

    def after(self, base: _Tally) -> _Tally:
        return _Tally(self.counts.after(base.counts), self.drops + base.drops, self.waits + base.waits)


class Counts(Watcher):
    """Keeps the status. A process that was started again counts from nothing; what came before is added."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._base: dict[str, _Tally] = defaultdict(_Tally)
        self._reported: dict[str, _Tally] = defaultdict(_Tally)
        self._missed: dict[str, Counter[tuple[str, str]]] = defaultdict(Counter)

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
            self._reported[name].counts = OperatorCounts(*values)
        for name, found in drops.items():
            self._reported[name].drops = Counter({(input_name, why): n for input_name, why, n in found})
        for name, found in waits.items():
            self._reported[name].waits = Counter({(input_name, what): n for input_name, what, n in found})
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
            self._missed[name][input_name, MISSED] += max(0, number)
            self._update(name)

    def _update(self, name: str) -> None:
        status, missed = self.run.status, self._missed[name]
        found = self._reported[name].after(self._base[name])
        status.operators[name] = found.counts.after(OperatorCounts(dropped=missed.total())) if missed else found.counts
        if drops := found.drops + missed:
            status.drops[name] = drops
        if found.waits:
            status.waits[name] = found.waits

    def away(self, process: Supervised) -> None:
        for name in process.nodes:
            self._base[name] = self._reported.pop(name, _Tally()).after(self._base[name])
