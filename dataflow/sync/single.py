"""The aligner of an operator with one input of one stream, as most have: every message fires as it comes.

It decides what `Aligner` does, which it falls back upon for everything else; here is the short way.
"""

from __future__ import annotations

from dataflow.sync.aligner import Aligner
from dataflow.sync.entries import Entry, Firing, InputValue, Waiting
from dataflow.sync.spec import AlignSpec
from dataflow.sync.stamps import FOREVER, NEVER

_NO_NAMES: frozenset[str] = frozenset()


def make_aligner(spec: AlignSpec) -> Aligner:
    """Makes the aligner that suits a specification."""
    streams = [stream for trigger in spec.triggers for stream in trigger.streams]
    alone = len(streams) == 1 and not (spec.sampled or spec.batches or spec.static or spec.every is not None)
    return SingleAligner(spec) if alone else Aligner(spec)


class SingleAligner(Aligner):
    """Decides the firings of one trigger of one stream that is not static, and of nothing else."""

    def __init__(self, spec: AlignSpec) -> None:
        super().__init__(spec)
        (trigger,) = spec.triggers
        (self._lane,) = self._inputs.lanes[trigger.name]
        self._state = self._lane.state
        self._many = trigger.many

    def push(self, stream: str, entry: Entry) -> None:
        lane, state, stamp = self._lane, self._state, entry.stamp
        if (
            stream == state.name
            and entry.stream
            and entry.incarnation == state.incarnation
            and stamp > state.promised
            and stamp > lane.frontier
            and stamp < FOREVER
            and state.first is not None
            and not state.ended
        ):
            lane.entries.append(entry)
            state.last = state.promised = lane.frontier = stamp
            self._undecided.settled = False
        else:
            super().push(stream, entry)

    def poll(self, most: int | None = None) -> Firing | None:
        lane = self._lane
        entries = lane.entries
        if self._finished or not entries or entries[0].stamp > lane.frontier:
            return super().poll(most)
        undecided = self._undecided
        self.paused = undecided.settled = False
        entry = entries.popleft()
        stamp = undecided.decided = self._last_firing = self._triggers.decided = entry.stamp
        value: InputValue = {lane.state.name: entry} if self._many else entry
        return Firing(stamp, "fire", False, {lane.input: value}, _NO_NAMES, _NO_NAMES)

    def waiting(self) -> Waiting | None:
        return super().waiting() if self._lane.entries else None

    def idle_frontier(self) -> int:
        frontier = self._lane.frontier
        if self._lane.entries or frontier == FOREVER or self._finished:
            return NEVER
        if frontier > self._undecided.decided:
            self._undecided.decided = frontier
        return self._undecided.decided
