"""What the supervisor of a live run holds of one operator, so that a new process can take the place of a dead one."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from dataflow.records.firing import WITHHELD, decode_batch

HELD_RECORDS = 4096


@dataclass(slots=True)
class Reached:
    """Where an operator has got to by its firing records: its incarnation, the last stamp of each port, and the
    parameters that were changed."""

    incarnation: int = 0
    last: dict[str, int] = field(default_factory=dict)
    changed: dict[str, Any] = field(default_factory=dict)

    def take(self, batch: bytes, ports: Sequence[str]) -> None:
        """Goes on by the next batch of records; `ports` are the operator's outputs as declared."""
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
    """The latest `size` batches of an operator's firing records, and where it had got to before them."""

    def __init__(self, ports: Sequence[str], size: int = HELD_RECORDS) -> None:
        self.ports, self.size = tuple(ports), size
        self.batches: deque[bytes] = deque()
        self._before = Reached()

    def add(self, batch: bytes) -> None:
        if len(self.batches) == self.size:
            self._before.take(self.batches.popleft(), self.ports)
        self.batches.append(batch)

    def resumed(self) -> dict[str, Any]:
        """What the next process of this operator begins with: what `host_config.Resumed` holds, as plain values."""
        reached = replace(self._before, last=dict(self._before.last), changed=dict(self._before.changed))
        for batch in self.batches:
            reached.take(batch, self.ports)
        return {"incarnation": reached.incarnation + 1, "last": reached.last, "changed": reached.changed}
