"""Join: the triggers' messages meet, at one stamp or as mutually nearest within a tolerance.

The first trigger is the *anchor*; its stamp is the firing's. Anchor t and message x of another trigger match
iff each is the other's nearest within the tolerance, ties to the earlier stamp. Nearest is over all messages,
those already matched included, so a message matches at most once. A greedy search pairs differently: with
tolerance 10, anchors 0 and 10 and x = 9 it would take (0, 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from dataflow.sync.entries import DropReason, Entry, InputValue
from dataflow.sync.lanes import DropEntry, Lane
from dataflow.sync.stamps import FOREVER, NEVER


class _Unknown:
    """Holds what is needed before a partner can be named: on the other input, or on the anchor."""

    __slots__ = ("anchor", "other")

    def __init__(self, other: int | None = None, anchor: int | None = None) -> None:
        self.other = other
        self.anchor = anchor


_NO_PARTNER: Final = None


class Join:
    """Decides the anchors in order; the head of the anchor's lane is the first undecided one."""

    def __init__(self, lanes: Sequence[Lane], tolerance: int, drop: DropEntry) -> None:
        self._anchor = lanes[0]
        self._others = tuple(lanes[1:])
        self._tolerance = tolerance
        self._drop = drop
        self._partners: list[Entry | _Unknown] = []
        self.stamp: int | None = None
        """The first anchor not decided, or None."""
        self.ready = False
        """True when `stamp` has a partner on every other trigger."""
        self.bound = NEVER
        """`stamp`, else the minimum of the trigger frontiers: no other firing lies at or below it."""
        self.decided = NEVER
        """The last anchor decided, matched or not."""

    def settle(self) -> None:
        """Passes over the anchors known to be unmatched, up to the first that matches or is undecided."""
        anchors = self._anchor.entries
        while anchors:
            self.stamp = self.bound = anchors[0].stamp
            if self._match(self.stamp):
                self.ready = not any(isinstance(partner, _Unknown) for partner in self._partners)
                return
            self._pass("unmatched", "")
        self.stamp = None
        self.ready = False
        self.bound = self._anchor.frontier
        for lane in self._others:
            self.bound = min(self.bound, lane.frontier)
            self._forget(lane)

    def take(self) -> dict[str, InputValue]:
        """The anchor at `stamp` and its partners, which are thereby decided."""
        values: dict[str, InputValue] = {self._anchor.input: self._pop_anchor()}
        for lane, partner in zip(self._others, self._partners, strict=True):
            assert isinstance(partner, Entry)
            while lane.entries[0] is not partner:
                self._drop(lane, lane.entries.popleft(), "unmatched", "")
            lane.entries.popleft()
            lane.removed = partner.stamp
            values[lane.input] = partner
        return values

    def reject(self, reason: DropReason, because: str) -> None:
        """Decides `stamp`, which has matched, without a firing."""
        for name, entry in self.take().items():
            lane = self._anchor if name == self._anchor.input else next(o for o in self._others if o.input == name)
            assert isinstance(entry, Entry)
            self._drop(lane, entry, reason, because)

    def absent(self) -> dict[str, InputValue]:
        """The values of the triggers where none has a message."""
        return {lane.input: None for lane in (self._anchor, *self._others)}

    def needs(self) -> dict[str, int]:
        """The frontier each trigger must reach for `stamp` to be decided."""
        needed: dict[str, int] = {}
        if self.stamp is None:
            return needed
        for lane, partner in zip(self._others, self._partners, strict=True):
            if isinstance(partner, _Unknown):
                if partner.other is not None:
                    needed[lane.input] = partner.other
                if partner.anchor is not None:
                    needed[self._anchor.input] = max(partner.anchor, needed.get(self._anchor.input, NEVER))
        return needed

    def oldest_wait(self) -> tuple[int, dict[str, int]] | None:
        """While no anchor waits: the oldest message of the others, and the anchor frontier to rule it out."""
        heads = [lane.entries[0].stamp for lane in self._others if lane.entries]
        return (min(heads), {self._anchor.input: min(heads) + self._tolerance}) if heads else None

    def _match(self, stamp: int) -> bool:
        """Returns whether the anchor at `stamp` matches or still may; leaves what is known in `_partners`."""
        self._partners = []
        for lane in self._others:
            partner = self._partner(lane, stamp)
            if partner is _NO_PARTNER:
                return False
            self._partners.append(partner)
        return True

    def _partner(self, lane: Lane, stamp: int) -> Entry | _Unknown | None:
        entries = lane.entries
        while len(entries) > 1 and entries[1].stamp <= stamp:  # for this anchor and all later ones the next is nearer
            self._discard(lane)
        below = above = None  # the newest at or before the anchor, the oldest after it
        if entries and entries[0].stamp <= stamp:
            below = entries[0]
            if len(entries) > 1:
                above = entries[1]
        elif entries:
            above = entries[0]
        below_stamp = below.stamp if below is not None else None
        above_stamp = above.stamp if above is not None else None
        if lane.removed is not None:  # taken entries are matched no more, but may still be the nearest of another
            if lane.removed > stamp:
                above, above_stamp = None, lane.removed
            elif below_stamp is None:
                below_stamp = lane.removed

        if above_stamp is None:
            enough = min(stamp + self._tolerance, FOREVER)
            if below_stamp is not None:
                enough = min(enough, 2 * stamp - below_stamp - 1)
            if lane.frontier < enough:
                return _Unknown(other=enough)
        if above_stamp is not None and (below_stamp is None or above_stamp - stamp < stamp - below_stamp):
            if above is None or above_stamp - stamp > self._tolerance:
                return _NO_PARTNER
            return self._unless_next_anchor_is_nearer(above, stamp)
        if below is None or stamp - below.stamp > self._tolerance:
            return _NO_PARTNER
        previous = self.decided
        if previous != NEVER and abs(below.stamp - previous) <= stamp - below.stamp:
            return _NO_PARTNER
        return below

    def _unless_next_anchor_is_nearer(self, above: Entry, stamp: int) -> Entry | _Unknown | None:
        anchors = self._anchor.entries
        enough = min(2 * above.stamp - stamp - 1, FOREVER)
        if len(anchors) > 1:
            return above if anchors[1].stamp > enough else _NO_PARTNER
        return above if self._anchor.frontier >= enough else _Unknown(anchor=enough)

    def _pass(self, reason: DropReason, because: str) -> None:
        anchor = self._pop_anchor()
        self._drop(self._anchor, anchor, reason, because)
        for lane in self._others:
            while lane.entries and lane.entries[0].stamp <= anchor.stamp:
                self._discard(lane)

    def _forget(self, lane: Lane) -> None:
        """Discards what no anchor above the anchor's frontier can match."""
        frontier, entries = self._anchor.frontier, lane.entries
        while entries and (
            entries[0].stamp + self._tolerance <= frontier or (len(entries) > 1 and entries[1].stamp <= frontier + 1)
        ):
            self._discard(lane)

    def _discard(self, lane: Lane) -> None:
        entry = lane.entries.popleft()
        lane.removed = entry.stamp
        self._drop(lane, entry, "unmatched", "")

    def _pop_anchor(self) -> Entry:
        anchor = self._anchor.entries.popleft()
        self.decided = anchor.stamp
        return anchor
