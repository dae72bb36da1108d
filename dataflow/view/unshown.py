"""Poses of frames from streams that are not shown: taken where something shown needs them and nothing shown gives them.

A hidden stream must not take the frames of what is shown with it; nor must it bring its frames into
the picture, or win a frame from a stream that is shown. Pure.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dataflow.view.frames import FrameTree, Matrix, Rank


@dataclass(frozen=True, slots=True)
class Offer:
    """The place of a frame by a stream that is not shown: `T_parent_child` (4×4) in `parent`."""

    parent: str
    T_parent_child: Matrix
    stream: str
    rank: Rank
    stamp: int
    static: bool


@dataclass(slots=True)
class Unshown:
    """The newest offer for each frame; an estimate goes before truth."""

    _offers: dict[str, Offer] = field(default_factory=dict)
    _wanted: dict[str, int] = field(default_factory=dict)

    def offer(self, child: str, offer: Offer) -> None:
        held = self._offers.get(child)
        if held is None or held.stream == offer.stream or offer.rank < held.rank:
            self._offers[child] = offer

    def needed(self, tree: FrameTree, child: str, stamp: int) -> Offer | None:
        """Returns the offer that is to place `child` now, if any.

        What moves is taken a message later than it is first wanted: what is shown and of the same stamp may place it.
        """
        offer = self._offers.get(child)
        if offer is None or child not in tree:
            return None
        owner = tree.owner(child)
        if owner == offer.stream:
            return offer
        if owner is not None:
            return None
        return offer if offer.static or self._wanted.setdefault(child, stamp) < stamp else None
