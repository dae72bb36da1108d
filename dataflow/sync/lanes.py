"""The state of one stream, and of one lane: the way from a stream into one input."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Literal

from dataflow.sync.entries import DropReason, Entry, StreamOrderError
from dataflow.sync.stamps import FOREVER, NEVER, format_stamp

Role = Literal["trigger", "sampled", "batch"]

PRUNE_AT = 32
"""Entries in a Sampled or Batch lane at which pruning is first tried; then at twice what was left."""


class StreamState:
    """Holds what a stream has said about itself, whatever inputs it feeds, and whether it keeps to it."""

    __slots__ = ("ended", "final", "first", "floor", "incarnation", "lanes", "last", "name", "promised", "static")

    def __init__(self, name: str, static: bool) -> None:
        self.name = name
        self.static = static
        self.lanes: list[Lane] = []
        self.incarnation = 0
        self.first: int | None = None
        self.last = NEVER
        self.promised = NEVER
        """The frontier the stream itself promised: the next stamp must be greater."""
        self.floor = NEVER
        """The last stamp of earlier incarnations: what is not above it is late, not wrong."""
        self.ended = False
        self.final: int | None = None

    def accept(self, entry: Entry) -> bool:
        """Takes note of a message. False if it is late, as the stream restarted; raises if it is wrong."""
        stamp = entry.stamp
        if stamp >= FOREVER:
            raise StreamOrderError(self.name, f"message {entry.seq} lies at the end of time")
        if stamp <= self.promised or self.ended or entry.incarnation != self.incarnation:
            self._check_order(entry)
            return False
        if self.first is None:
            self.first = stamp
        self.last = self.promised = stamp
        if self.static:
            self.ended = True
        return True

    def advance(self, frontier: int) -> bool:
        """Takes note of a promise; False if it promises nothing new."""
        if frontier >= FOREVER:
            raise StreamOrderError(
                self.name, "a frontier lies before the end of time; a stream that is over sends its end"
            )
        if self.ended or self.static or frontier <= self.promised:
            return False
        self.promised = frontier
        return True

    def end(self, final_stamp: int | None) -> None:
        """Takes note of the end; without a final stamp the stream went as far as it promised."""
        if final_stamp is None:
            final_stamp = self.promised if self.promised != NEVER else None
        elif final_stamp < self.promised:
            raise StreamOrderError(
                self.name,
                f"it ends with final stamp {format_stamp(final_stamp)}, below its promised frontier "
                f"{format_stamp(self.promised)}: pass the larger of last stamp and frontier",
            )
        if final_stamp is not None and final_stamp >= FOREVER:
            raise StreamOrderError(self.name, "its final stamp lies at the end of time")
        self.ended = True
        self.final = final_stamp

    def reset(self, incarnation: int) -> None:
        """Begins a new incarnation, which is open, and late up to where the old ones came."""
        if incarnation <= self.incarnation:
            raise StreamOrderError(self.name, f"incarnation {incarnation} after {self.incarnation}")
        self.incarnation = incarnation
        if self.static:
            self.last = NEVER
        self.floor = self.promised = self.last
        self.ended = False

    def _check_order(self, entry: Entry) -> None:
        """Returns if the message lies in the time of earlier incarnations; raises if it breaks a promise."""
        what = f"message {entry.seq} at {format_stamp(entry.stamp)}"
        if entry.incarnation < self.incarnation:
            problem = f"{what} is of incarnation {entry.incarnation}, after {self.incarnation}"
        elif self.ended:
            problem = f"{what}: {'a static stream carries one message' if self.static else 'the stream has ended'}"
        elif entry.stamp <= self.floor:
            return
        elif entry.stamp <= self.last:
            problem = f"{what} does not come after {format_stamp(self.last)}: stamps strictly increase"
        else:
            problem = f"{what} breaks the promised frontier {format_stamp(self.promised)}"
        raise StreamOrderError(self.name, problem)


class Lane:
    """A stream on its way into one input: entries not yet decided, and the frontier as that input sees it."""

    __slots__ = ("delay", "entries", "frontier", "input", "late", "limit", "removed", "role", "state")

    def __init__(self, input: str, role: Role, state: StreamState, delay: int = 0) -> None:
        self.input = input
        self.role: Role = role
        self.state = state
        self.delay = delay
        self.entries: deque[Entry] = deque()
        self.frontier = NEVER
        """The stream's frontier, or a greater forced one."""
        self.removed: int | None = None
        """Stamp of the newest entry taken out, which a join still measures distances to."""
        self.late = NEVER
        """Stamp of the newest entry that came after a firing that should have had it."""
        self.limit = PRUNE_AT

    @property
    def reach(self) -> int:
        """Returns how far the stream is known to go: its final stamp once it ended, else its frontier."""
        if not self.state.ended:
            return self.frontier
        return NEVER if self.state.final is None else self.state.final

    def raise_frontier(self, frontier: int) -> None:
        """The frontier is at least `frontier`."""
        if frontier > self.frontier:
            self.frontier = frontier

    def reopen(self, decided: int) -> None:
        """The stream, which had ended, goes on; what is decided stays so."""
        if not self.state.static and self.frontier == FOREVER:
            self.frontier = max(self.state.last, decided)


DropEntry = Callable[[Lane, Entry, DropReason, str], None]
