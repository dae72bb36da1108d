"""The chain of calls that decided a value, as it was found."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from dataflow.blame.field import change, is_measured
from dataflow.blame.line import Call
from dataflow.blame.nudge import SIZE
from dataflow.blame.repeated_calls import Place

Way = Literal["nudged", "made finite", "the one before", "left out", "another", "call left out", "a new operator"]
"""The change of an input, or of the calls before."""
OTHER_CONTENT: frozenset[Way] = frozenset({"the one before", "another"})
"""Ways that put the content of another message in place of one."""


@dataclass(frozen=True, slots=True)
class Effect:
    """The value (None: none) that came when an input was another; `way`: how, and the fields nudged.

    `together`: how many inputs, or calls, were others at once, none of which changes the value alone (a tie).
    """

    way: Way
    fields: tuple[str, ...]
    value: Any
    together: int = 1


@dataclass(frozen=True, slots=True)
class Link:
    """An input of a call, or with `input` "" the state before it, that decided the value.

    - `call`: the one that took it; `stamp`: its, in ns.
    - `message`: of an input. `maker`: the call that made the message, or that left its mark in the state; None where it
      comes from a source, or from an operator that is not made again, and for a state that the operator was given
      before `call` (a reload, a beginning in the middle).
    - `effects`: the changes of it that changed the value.
    - `last`: where messages of the stream, or calls, decide together, the number of the last of them.
    """

    call: Call
    stamp: int
    input: str
    message: Place | None
    message_stamp: int
    maker: Call | None
    effects: tuple[Effect, ...]
    last: int | None = None

    @property
    def messages(self) -> list[Place]:
        """Returns the places of its messages."""
        if self.message is None:
            return []
        stream, incarnation, number = self.message
        return [(stream, incarnation, n) for n in range(number, (number if self.last is None else self.last) + 1)]


class UntestedInput(NamedTuple):
    """An input of a call, or with `input` "" what the calls up to `last` leave in the state, of which every change made
    a call raise: not known is whether it decides. `error`: the last one's."""

    call: Call
    last: int
    input: str
    error: str


@dataclass(slots=True)
class Chain:
    """The calls that decided a value.

    - `value`, of the message `place` that `target` made at `stamp` (ns). `late`: the recording had ended before the
      time that was asked for. `links`: why each is on the chain, that with the largest effect first.
    - `sensed`: the links at the chain's ends.
    - `loose`: calls on the chain of which nothing that was tried changes the value.
    - `tried`: how often each way was tried; `raised`: of these, by the error, how often a call raised, which shows
      nothing. `untried`: inputs of which nothing else was seen.
    - `left`: calls on the chain that were not looked into, as the time or the memory for inputs was up.
      `unsplit`: operator, first and last of calls of which some left their mark in the state, which were not found for
      the same reason, or as the operator was given its state behind them.
    - `ended`: by operator, the call before which a new operator gives the same value, so that none before was tried.
    """

    target: Call
    place: Place
    stamp: int
    value: Any
    late: bool = False
    links: list[Link] = field(default_factory=list)
    loose: list[Call] = field(default_factory=list)
    tried: Counter[Way] = field(default_factory=Counter)
    raised: Counter[str] = field(default_factory=Counter)
    untried: list[UntestedInput] = field(default_factory=list)
    left: list[Call] = field(default_factory=list)
    unsplit: list[tuple[str, int, int]] = field(default_factory=list)
    ended: dict[str, int] = field(default_factory=dict)
    made: int = 0
    seconds: float = 0.0

    @property
    def whole(self) -> bool:
        """Returns whether all of it was looked into, and leads to what was sensed, or to a state that was given."""
        return not (self.left or self.unsplit or self.untried or self.loose)

    @property
    def sensed(self) -> list[Link]:
        """Returns the links to messages that no call made."""
        return [link for link in self.links if link.input and link.maker is None]

    def weight(self, link: Link) -> tuple[float, float]:
        """Returns by how much the value is another at most, to two digits.

        First where a message itself, or a call, is left out or nudged (the effect of a nudge on floating-point values
        counts `1 / SIZE` times), then with the content of another message in its place, which may count more than its
        own.
        """
        own, others = 0.0, 0.0
        for effect in link.effects:
            size = change(self.value, effect.value)
            if effect.way in OTHER_CONTENT:
                others = max(others, size)
            else:
                own = max(own, size / SIZE if effect.way == "nudged" and is_measured(self.value) else size)
        return float(f"{own:.1e}"), float(f"{others:.1e}")

    def loose_of(self, calls: Sequence[Call]) -> list[Call]:
        """Returns those of some calls from which no link leads on: neither its own, nor one found for a later call.

        A call that counts only by what another content would do, beside one that counts by its own, need not lead on.
        """
        aside = self._aside()
        return [call for call in calls if call not in aside and not self._leads_on(call)]

    def _leads_on(self, call: Call) -> bool:
        return any(
            link.call == call
            or (
                not link.input
                and link.maker is not None
                and link.call.operator == call.operator
                and link.maker.number < call.number <= link.call.number
            )
            for link in self.links
        )

    def _aside(self) -> set[Call]:
        """Returns the calls to which links lead only by another content, from calls that have other links, too, or that
        are such calls themselves."""
        others = {id(link) for link in self.links if OTHER_CONTENT.issuperset(e.way for e in link.effects)}
        counts = {link.call for link in self.links if id(link) not in others}
        to: dict[Call, list[Link]] = defaultdict(list)
        for link in self.links:
            if link.maker is not None:
                to[link.maker].append(link)
        found: set[Call] = set()
        while True:
            more = {
                call
                for call, links in to.items()
                if call not in found
                and all(link.call in found or (link.call in counts and id(link) in others) for link in links)
            }
            if not more:
                return found
            found |= more

    def was_raised(self, call: Call, last: int, name: str, error: str) -> None:
        """Notes what could not be tried; calls beside those that were noted before are noted with them."""
        for k, noted in enumerate(self.untried):
            if not name and not noted.input and noted.call.operator == call.operator and last + 1 >= noted.call.number:
                self.untried[k] = UntestedInput(min(call, noted.call), max(last, noted.last), "", error)
                return
        self.untried.append(UntestedInput(call, last, name, error))

    def as_json(self) -> dict[str, Any]:
        """Returns it as JSON values; a value that is no number is as the message holds it."""
        return {
            "value": self.value,
            "call": [*self.target],
            "stamp": self.stamp,
            "beyond_the_end": self.late,
            "links": [_link_as_json(link) for link in self.links],
            "sensed": [[*place] for place in dict.fromkeys(p for link in self.sensed for p in link.messages)],
            "whole": self.whole,
            "no_change_shows_at": [[*call] for call in self.loose],
            "tried": dict(self.tried),
            "raised": dict(self.raised),
            "could_not_be_tried": [
                {"call": [*each.call], "to": each.last, "input": each.input or None, "error": each.error}
                for each in self.untried
            ],
            "not_looked_into": [[*call] for call in self.left],
            "not_taken_apart": [[*each] for each in self.unsplit],
            "not_tried_before": dict(self.ended),
            "calls_made": self.made,
            "seconds": self.seconds,
        }


def _link_as_json(link: Link) -> dict[str, Any]:
    effects = [{"way": e.way, "fields": e.fields, "value": e.value, "together": e.together} for e in link.effects]
    return {
        "call": [*link.call],
        "stamp": link.stamp,
        "input": link.input or None,
        "message": None if link.message is None else [*link.message],
        "from": None if link.maker is None else [*link.maker],
        "to": link.last,
        "effects": effects,
    }
