"""Decides which envelopes of one stream its taker believes: those that go on from what the stream has said so far.

Every envelope names a place, (incarnation, number): a message its own, a frontier or an end that of the next message. A
stream's places are gapless. Envelopes come through a ring to which only the stream's own process writes, so an envelope
at a later place means that messages were lost, or that the stream has begun a new incarnation. One at an earlier place,
or one that breaks a promise, contradicts the stream and does not count.

A process that is started again after its streams have ended, and has nothing more to say, ends them once more, in the
next incarnation. Who waits for that end gets the first one again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from dataflow.sync import FOREVER, NEVER
from dataflow.transport import Envelope, Kind

_MESSAGE = Kind.MESSAGE
Place = tuple[int, int]
"""Incarnation, and number within it."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Returns what follows from one envelope."""

    taken: Envelope | None = None
    """The envelope to take in its place; None: it does not count."""
    gap: tuple[int, int] | None = None
    """The numbers that were lost before it: first and following."""
    repeats: bool = False
    """It promises nothing new, and need not be taken."""
    damaged: str = ""
    """Why a message that may well be the stream's own had to be refused."""


class StreamOrder:
    """Follows one stream that is not static. A pure state machine: envelopes in, verdicts out. `first` is the place
    that the stream begins with; None for a taker that may come late: until the first message it believes any place."""

    def __init__(self, first: Place | None = None) -> None:
        self.incarnation = 0
        self._next = first
        self._promised = NEVER
        self._end: Envelope | None = None

    def goes_on(self, envelope: Envelope) -> bool:
        """Takes a message that simply goes on: at the place that is due, above what was promised. False, and nothing is
        taken note of, for anything else: that is for `take`."""
        if (
            envelope.kind is not _MESSAGE
            or self._end is not None
            or (envelope.incarnation, envelope.seq) != self._next
            or envelope.incarnation != self.incarnation
            or not self._promised < envelope.stamp < FOREVER
        ):
            return False
        self._next, self._promised = (envelope.incarnation, envelope.seq + 1), envelope.stamp
        return True

    def take(self, envelope: Envelope) -> Verdict:
        """Returns what may be believed after this envelope."""
        kind, place, due = envelope.kind, (envelope.incarnation, envelope.seq), self._next
        if kind not in (Kind.MESSAGE, Kind.FRONTIER, Kind.END) or envelope.stamp >= FOREVER:
            return Verdict()
        gap = None
        if due is not None and place < due:
            back = kind is Kind.MESSAGE and envelope.incarnation < self.incarnation
            return Verdict(damaged=f"went back to incarnation {envelope.incarnation}" if back else "")
        if due is not None and place > due:
            first = due[1] if envelope.incarnation == due[0] else 0
            gap = (first, envelope.seq) if envelope.seq > first else None
        if kind is Kind.MESSAGE and envelope.incarnation > self.incarnation:
            self.incarnation, self._promised, self._end = envelope.incarnation, NEVER, None
        if kind is Kind.MESSAGE:
            self._next = envelope.incarnation, envelope.seq + 1
        elif due is not None and (envelope.incarnation == due[0] or gap is not None):
            self._next = place
        if kind is Kind.FRONTIER and envelope.stamp <= self._promised:
            return Verdict(gap=gap, repeats=True)
        if self._end is not None:
            if envelope.incarnation <= self._end.incarnation:
                return Verdict(gap=gap)
            if kind is Kind.FRONTIER:
                return Verdict(gap=gap, repeats=True)
            self._end = replace(self._end, incarnation=envelope.incarnation)
            return Verdict(self._end, gap)
        if kind is Kind.MESSAGE and envelope.stamp <= self._promised:
            why = f"broke its promise with number {envelope.seq}, stamp {envelope.stamp}"
            return Verdict(gap=gap, damaged=why)
        return Verdict(self._as_promised(envelope), gap)

    def _as_promised(self, envelope: Envelope) -> Envelope:
        """Takes note of the promise. An end below an earlier promise (of a clock that jumped back) is raised to it."""
        if envelope.kind is Kind.END:
            if NEVER < envelope.stamp < self._promised:
                envelope = replace(envelope, stamp=self._promised)
            self._end = envelope
        self._promised = max(self._promised, envelope.stamp)
        return envelope
