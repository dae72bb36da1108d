"""Firing records that the supervisor of a live run holds, so that a new process can take the place of a dead one."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dataflow.records.firing import WITHHELD, decode_batch
from dataflow.supervision.part import Part
from dataflow.supervision.run_state import RunState
from dataflow.supervision.supervised import Supervised

HELD_RECORDS = 4096
HELD_BYTES = 16 << 20
"""Bounds for one operator. A record can hold a snapshot of any size: the last one is held whatever it takes."""


@dataclass(slots=True)
class Reached:
    """How far an operator has got by its firing records: its incarnation, the last stamp of each port, and the
    parameters that were changed."""

    incarnation: int = 0
    last: dict[str, int] = field(default_factory=dict)
    changed: dict[str, Any] = field(default_factory=dict)

    def take(self, batch: bytes, ports: Sequence[str]) -> None:
        """Takes in the next batch of records; `ports` are the operator's outputs as declared."""
        for record in decode_batch(batch).records:
            if record.kind == "reset":
                self.last.clear()
            if record.kind == "param":
                self.changed[record.detail["name"]] = record.detail["value"]
            self.incarnation = max(self.incarnation, record.incarnation)
            for port, emission in zip(ports, record.outputs, strict=False):
                if emission is not None and emission.seq != WITHHELD and record.kind != "setup":
                    self.last[port] = emission.stamp


class HeldRecords:
    """The latest batches of an operator's firing records, bounded in number and bytes, and the state before them."""

    def __init__(self, ports: Sequence[str], size: int = HELD_RECORDS, nbytes: int = HELD_BYTES) -> None:
        self.ports, self.size, self.nbytes = tuple(ports), size, nbytes
        self.batches: deque[bytes] = deque()
        self.held = 0
        """Bytes in `batches`."""
        self._before = Reached()

    def add(self, batch: bytes) -> None:
        self.batches.append(batch)
        self.held += len(batch)
        while len(self.batches) > 1 and (len(self.batches) > self.size or self.held > self.nbytes):
            oldest = self.batches.popleft()
            self.held -= len(oldest)
            self._before.take(oldest, self.ports)

    def resumed(self) -> dict[str, Any]:
        """Returns what the next process of this operator begins with: the fields of `Resumed`, as plain values."""
        reached = replace(self._before, last=dict(self._before.last), changed=dict(self._before.changed))
        for batch in self.batches:
            reached.take(batch, self.ports)
        return {"incarnation": reached.incarnation + 1, "last": reached.last, "changed": reached.changed}


class HeldRecordsPart(Part):
    """Holds the records of every operator, and gives them to the recorder when it may lack some."""

    def __init__(self, run: RunState) -> None:
        super().__init__(run)
        self._held: dict[str, HeldRecords] = {}
        self.forget(run.graph.nodes)

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        if kind == "record":
            self._held[fields["operator"]].add(fields["data"])
        elif kind == "lacks":
            self.hand_over([fields["operator"]])

    def forget(self, operators: Iterable[str]) -> None:
        """Begins anew for these operators."""
        for name in operators:
            self._held[name] = HeldRecords(tuple(self.run.graph.nodes[name].outputs))

    def hand_over(self, operators: Iterable[str]) -> None:
        """Gives the recorder the records held of some operators; it leaves out what it has."""
        for name in operators:
            if batches := list(self._held[name].batches):
                self.run.tell_recorder("records", batches=batches)

    def resumed(self, operator: str) -> dict[str, Any]:
        return self._held[operator].resumed()
