"""Calls of an operator that are made once for equal inputs and an equal past, whatever the replay."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import xxhash

from dataflow.drops.operator_process import operator_of
from dataflow.execution.calls import Calls, Place
from dataflow.execution.effects.journal import EFFECTS
from dataflow.graph.model import Graph, Node
from dataflow.messages.base import Message
from dataflow.records.firing import CALLS, FiringRecord
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sync import NEVER, Firing
from dataflow.sync.entries import entries_of

SPACING = 0.1
"""Seconds of work between two states that are kept."""
MOST_BYTES = 2**28
"""Of states, and of messages, that are kept of one operator."""
MOST_GIVEN = 2**32
"""Of the inputs of one operator since the last state that is kept."""
_NEW = b""


class ReplayedFirings:
    """Firings that an operator with a state was given in one replay. `pasts` are those behind each, before them `_NEW`.

    Of firings before a state that is kept only the stamps are left; `nbytes`: of the inputs of the others.
    """

    def __init__(self) -> None:
        self.pasts, self.firings = [_NEW], list[Firing]()
        self.nbytes = 0
        self._left = 0

    def add(self, past: bytes, firing: Firing, *, known_state: bool) -> None:
        """Adds a firing; `known_state`: the state behind it is kept."""
        self.pasts.append(past)
        self.firings.append(firing)
        self.nbytes += sum(entry.value.nbytes() for given in firing.inputs.values() for entry in entries_of(given))
        if known_state:
            for k in range(self._left, len(self.firings)):
                self.firings[k] = replace(self.firings[k], inputs={})
            self._left, self.nbytes = len(self.firings), 0


class Player:
    """One operator, through all replays. Parameters change as in `records`, and effects get the answers in them."""

    def __init__(self, node: Node, graph: Graph, version: int, records: Sequence[FiringRecord]) -> None:
        self.node, self.stateless = node, node.operator.stateless
        self._parameters = _parameters_of(records)
        self._answers = {r.stamp: r.detail for r in records if r.kind in CALLS and EFFECTS in r.detail}
        self.operator = operator_of(node, graph.seed, version, graph.threads)
        self.statics: Mapping[str, Message] | None = None
        self.known: dict[bytes, Mapping[str, Message]] = {}
        """Outputs by the past up to the call."""
        self.summaries: dict[bytes, Mapping[str, float | int | str]] = {}
        self._states: dict[bytes, bytes] = {}
        self._held = self._state_bytes = 0
        self._at: bytes | None = None
        """The past of the operator as it is; None before its setup."""
        self._changed = 0
        """The number of the parameters' changes that an operator without a state has seen."""
        self._worked = 0.0
        self.made = 0

    def set_up(self) -> Mapping[str, Message]:
        """Sets the operator up, once; returns its static messages."""
        if self.statics is None:
            self.statics, self._at = self.operator.setup(), _NEW
        return self.statics

    def bring(self, given: ReplayedFirings) -> None:
        """Brings the operator to behind what it was given."""
        pasts, firings = given.pasts, given.firings
        if self.stateless or self._at == pasts[-1]:
            return
        near = next(
            k for k in range(len(pasts) - 1, -1, -1) if not k or pasts[k] in self._states or pasts[k] == self._at
        )
        if pasts[near] != self._at:
            self.operator.anew()
            for _, name, value in self._due(NEVER, firings[near - 1].stamp if near else NEVER):
                self.operator.parameter(name, value, (0, NEVER))
            if near:
                self.operator.restore(self._states[pasts[near]], (0, firings[near - 1].stamp))
            self._at = pasts[near]
        for k in range(near, len(pasts) - 1):
            self._call(firings[k], firings[k - 1].stamp if k else NEVER, pasts[k + 1])

    def process(self, given: ReplayedFirings, firing: Firing) -> Mapping[str, Message]:
        """Makes the firing behind those, or gives what it gave in another replay; `given` is carried on.

        Raises what the operator raises, and `ReplayError` where too much would have to be kept.
        """
        past = _past(b"" if self.stateless else given.pasts[-1], firing)
        if (known := self.known.get(past)) is None:
            self.bring(given)
            known = self._call(firing, given.firings[-1].stamp if given.firings else NEVER, past)
            self._held += sum(message.nbytes() for message in known.values())
            if self._held <= MOST_BYTES:
                self.known[past] = known
        if not self.stateless:
            given.add(past, firing, known_state=past in self._states)
            if given.nbytes > MOST_GIVEN:
                raise ReplayError(
                    f"{self.node.name} would have to be brought back over more than {MOST_GIVEN >> 30} GiB of inputs: "
                    "it gives no state, or one too large to be kept more often; take a part of the recording"
                )
        return known

    def _call(self, firing: Firing, before: int, past: bytes) -> Mapping[str, Message]:
        due = self._due(NEVER if self.stateless else before, firing.stamp)
        if self.stateless:
            if len(due) < self._changed:
                self.operator.anew()
                self._changed = 0
            due, self._changed = due[self._changed :], len(due)
        for _, name, value in due:
            self.operator.parameter(name, value, (0, firing.stamp - 1))
        began = time.perf_counter()
        self._at = None
        made = self.operator.process(firing, self._answers.get(firing.stamp, {}))
        self.made += 1
        self._at = past
        self._worked += time.perf_counter() - began
        if self._worked >= SPACING and not self.stateless and past not in self._states:
            self._worked = 0.0
            state = self.operator.snapshot((0, firing.stamp))
            if state is not None and self._state_bytes + len(state) <= MOST_BYTES:
                self._states[past] = state
                self._state_bytes += len(state)
        return made

    def _due(self, after: int, until: int) -> Sequence[tuple[int, str, Any]]:
        return [change for change in self._parameters if after < change[0] <= until]

    def close(self) -> None:
        """Closes the operator."""
        self.operator.close()


class PlayedCalls(Calls):
    """The calls of one replay, which a player makes."""

    def __init__(self, player: Player) -> None:
        super().__init__(player.node, player.operator.shell, 0)
        self._player = player
        self._given = ReplayedFirings()

    def setup(self) -> dict[str, Message]:
        return dict(self._player.set_up())

    def process(self, firing: Firing) -> dict[str, Message]:
        return dict(self._player.process(self._given, firing))

    def summary(self, place: Place) -> dict[str, float | int | str]:
        past = self._given.pasts[-1]
        if past not in self._player.summaries:
            self._player.bring(self._given)
            self._player.summaries[past] = self._player.operator.summary(place)
        return dict(self._player.summaries[past])


def _parameters_of(records: Sequence[FiringRecord]) -> list[tuple[int, str, Any]]:
    """Returns the changes of parameters of a run: (stamp of the last call before + 1 ns, name, value)."""
    found, last = [], NEVER
    for record in records:
        if record.kind == "param" and record.outcome != "error":
            found.append((last + 1, record.detail["name"], record.detail["value"]))
        last = record.stamp if record.kind in ("fire", "tick") else last
    return found


def _past(before: bytes, firing: Firing) -> bytes:
    hashed = xxhash.xxh3_128(before)
    hashed.update(f"{firing.stamp} {firing.kind} {firing.tick} {sorted(firing.stale)} {sorted(firing.late)}".encode())
    for name, given in sorted(firing.inputs.items()):
        hashed.update(f"{name} {type(given).__name__} ".encode())
        for entry in entries_of(given):
            hashed.update(entry.stream.encode() + entry.digest)
    return hashed.digest()
