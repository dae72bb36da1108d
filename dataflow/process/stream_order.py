"""Decides which envelopes of one stream its taker may believe: those that go on from what the stream has said so far.

Every envelope names a place, (incarnation, number): a message its own, a frontier or an end that of the next message. A
stream's places are gapless, so an envelope at the next place is taken, and one at an earlier place contradicts the
stream. One at a later place means that messages were lost, or that the stream has begun a new incarnation, or that
somebody else wrote it: it is held until the next envelope shows which. If that goes on from the held one, the held one
was the stream's own; if it is at the place that was due, the held one was not. Where the supervisor has announced that
the stream's process was restarted, a higher incarnation is believed at once.

A publisher therefore sends a frontier after the first message of a new incarnation, and one before its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from dataflow.sync import FOREVER, NEVER
from dataflow.transport import Envelope, Kind

Place = tuple[int, int]
"""Incarnation, and number within it."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Says what follows from one envelope."""

    taken: Sequence[Envelope] = ()
    """The envelopes to take, in order."""
    gap: tuple[int, int] | None = None
    """The numbers that were lost before them: first and following."""
    refused: int = 0
    """How many envelopes do not count."""
    damaged: str = ""
    """Why a message that may well be the stream's own had to be refused."""


class StreamOrder:
    """Follows one stream that is not static. A pure state machine: envelopes in, verdicts out.

    `first` is the place that the stream begins with; None for a taker that may come late: until the first message it
    believes any place.
    """

    def __init__(self, first: Place | None = None) -> None:
        self.incarnation = 0
        self._next = first
        self._promised = NEVER
        self._ended = False
        self._announced = False
        self._held: list[Envelope] = []

    def announce(self) -> None:
        """Notes that the stream's process was restarted: a higher incarnation is to come."""
        self._announced = True

    def goes_on(self, envelope: Envelope) -> bool:
        """Takes a message that simply goes on: at the place that is due, above what was promised, with nothing held.

        False, and nothing is taken note of, for anything else: that is for `take`.
        """
        if (
            envelope.kind is not Kind.MESSAGE
            or self._held
            or self._ended
            or (envelope.incarnation, envelope.seq) != self._next
            or envelope.incarnation != self.incarnation
            or not self._promised < envelope.stamp < FOREVER
        ):
            return False
        self._next, self._promised = (envelope.incarnation, envelope.seq + 1), envelope.stamp
        return True

    def take(self, envelope: Envelope) -> Verdict:
        """Returns what may be believed after this envelope."""
        if envelope.kind not in (Kind.MESSAGE, Kind.FRONTIER, Kind.END) or envelope.stamp >= FOREVER:
            return Verdict(refused=1)
        place = envelope.incarnation, envelope.seq
        if self._next is None or place == self._next:
            return self._go_on([envelope], refused=self._forget_held())
        if place < self._next:
            back = envelope.kind is Kind.MESSAGE and envelope.incarnation < self.incarnation
            return Verdict(refused=1, damaged=f"went back to incarnation {envelope.incarnation}" if back else "")
        if self._announced and envelope.incarnation > self._next[0]:
            return self._leap([envelope], refused=self._forget_held())
        if self._held and place == _following(self._held[-1]):
            held, self._held = self._held, []
            return self._leap([*held, envelope], refused=0)
        refused = self._forget_held()
        self._held.append(envelope)
        return Verdict(refused=refused)

    def _forget_held(self) -> int:
        refused = len(self._held)
        self._held.clear()
        return refused

    def _leap(self, envelopes: list[Envelope], refused: int) -> Verdict:
        """Goes on at a later place."""
        assert self._next is not None
        first = envelopes[0]
        due = self._next[1] if first.incarnation == self._next[0] else 0
        gap = (due, first.seq) if first.seq > due else None
        return self._go_on(envelopes, refused, gap)

    def _go_on(self, envelopes: list[Envelope], refused: int, gap: tuple[int, int] | None = None) -> Verdict:
        taken, damaged = [], ""
        for envelope in envelopes:
            if self._fits(envelope):
                taken.append(self._as_promised(envelope))
            elif envelope.kind is Kind.MESSAGE:
                damaged = f"broke its promise with number {envelope.seq}, stamp {envelope.stamp}"
        return Verdict(taken, gap, refused + len(envelopes) - len(taken), damaged)

    def _fits(self, envelope: Envelope) -> bool:
        """Takes note of a place that is believed; False for an envelope that breaks a promise."""
        if envelope.kind is Kind.MESSAGE and envelope.incarnation > self.incarnation:
            self.incarnation, self._promised, self._ended = envelope.incarnation, NEVER, False
            self._announced = False
        if envelope.kind is Kind.MESSAGE or (self._next is not None and envelope.incarnation == self._next[0]):
            self._next = _following(envelope)
        if envelope.incarnation <= self.incarnation and self._ended:
            return False
        return envelope.kind is not Kind.MESSAGE or envelope.stamp > self._promised

    def _as_promised(self, envelope: Envelope) -> Envelope:
        """Takes note of the promise. An end below an earlier promise (of a clock that jumped back) is raised to it."""
        if envelope.kind is Kind.END:
            self._ended = True
            if NEVER < envelope.stamp < self._promised:
                return replace(envelope, stamp=self._promised)
        self._promised = max(self._promised, envelope.stamp)
        return envelope


def _following(envelope: Envelope) -> Place:
    """The place of what follows an envelope."""
    return envelope.incarnation, envelope.seq + (envelope.kind is Kind.MESSAGE)
