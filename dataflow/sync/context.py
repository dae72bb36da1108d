"""The context of a firing: what its Sampled and Batch inputs have at its stamp."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from dataflow.sync.batch import Batch
from dataflow.sync.drops import DropLog
from dataflow.sync.entries import DropReason, Entry, InputValue
from dataflow.sync.lanes import PRUNE_AT, Lane
from dataflow.sync.sampled import Sampled
from dataflow.sync.spec import AlignSpec

_NO_NAMES: frozenset[str] = frozenset()


class InputAbsent(NamedTuple):
    """A required Sampled input has no value: there is no firing."""

    reason: DropReason
    input: str


class Context:
    """The Sampled and Batch inputs of one aligner."""

    __slots__ = ("_batches", "_drops", "_lanes", "_sampled", "empty", "late", "stale")

    def __init__(self, spec: AlignSpec, lanes: Mapping[str, Sequence[Lane]], drops: DropLog) -> None:
        self._drops = drops
        self._sampled = {s.name: Sampled(s, lanes[s.name]) for s in spec.sampled}
        self._batches = {b.name: Batch(b, lanes[b.name], drops.entry) for b in spec.batches}
        self._lanes = tuple(lane for name in (*self._sampled, *self._batches) for lane in lanes[name])
        self.empty = not self._lanes
        """True when there are no such inputs."""
        self.stale = self.late = _NO_NAMES
        """Of the last firing: inputs from which a message was withheld, inputs with one that came late."""

    def lanes(self) -> Iterator[Lane]:
        """The ways into these inputs."""
        return iter(self._lanes)

    def knows(self, stamp: int) -> bool:
        """Returns whether what belongs to `stamp` can no longer change."""
        for sampled in self._sampled.values():
            if not sampled.knows(stamp):
                return False
        for batch in self._batches.values():  # noqa: SIM110  asked for every firing: a loop costs half of `all`
            if not batch.knows(stamp):
                return False
        return True

    def needs(self, stamp: int) -> dict[str, int]:
        """The frontiers with which what belongs to `stamp` would be known."""
        inputs: tuple[Sampled | Batch, ...] = (*self._sampled.values(), *self._batches.values())
        return {each.name: need for each in inputs if (need := each.needs(stamp)) is not None}

    def take(self, stamp: int, last_firing: int) -> dict[str, InputValue] | InputAbsent:
        """The values at `stamp`, which are known; `InputAbsent`, and nothing is taken, where nothing is to fire."""
        values: dict[str, InputValue] = {}
        stale: list[str] = []
        late: list[str] = []
        for name, sampled in self._sampled.items():
            value = sampled.choose(stamp)
            if sampled.required and not value:
                return InputAbsent(sampled.why_absent(), name)
            values[name] = value
            if sampled.stale:
                stale.append(name)
            if sampled.late:
                late.append(name)
        for name, batch in self._batches.items():
            values[name] = batch.take(stamp, last_firing)
            if batch.late:
                late.append(name)
        self.stale = frozenset(stale) if stale else _NO_NAMES
        self.late = frozenset(late) if late else _NO_NAMES
        return values

    def push(self, lane: Lane, entry: Entry, last_firing: int) -> bool:
        """Takes a message; True when so many are held that it is time to `prune`."""
        if lane.state.static and lane.role == "sampled":
            lane.entries.clear()
        lane.entries.append(entry)
        if entry.stamp + lane.delay <= last_firing:
            lane.late = entry.stamp
            self._drops.came_late(lane)
        return len(lane.entries) > lane.limit

    def prune(self, lane: Lane, bound: int) -> None:
        """Forgets what no firing above `bound` can need. The limit doubles, so the cost per message stays small."""
        if lane.role == "sampled":
            self._sampled[lane.input].prune(lane, bound)
        else:
            self._batches[lane.input].prune(bound)
        lane.limit = max(PRUNE_AT, 2 * len(lane.entries))

    def finish(self) -> None:
        """Lets go of what came after the last firing; the messages of a Batch are dropped as `unused`."""
        for batch in self._batches.values():
            batch.drop_rest()
        for lane in self._lanes:
            lane.entries.clear()
