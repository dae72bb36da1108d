"""The account of a bag that was opened: what its file lacks, what was repaired, passed over, or had no room here."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from dataflow.recording.streams.streams import UnreadableMessages

WORDS = {
    "reordered": "put in order",
    "repeated": "recorded twice, once left out",
    "moved": "of an equal stamp, put 1 ns later",
    "merged": "joined with others of their stamp",
    "before_epoch": "before 1970, left out",
}
"""Repairs in words, by the names of `Repair.facts`."""


@dataclass(slots=True)
class Account:
    """Facts about a source and its messages; complete when all of them have been read.

    - `notes`: damage and oddities of the file; `short`: topics with fewer messages than are promised.
    - By topic: `repaired`, messages by what was done; `unread`; `lost`, messages by what of them is not carried over;
      `static`, what was made of several messages of a static topic; `doubted`, values that are hardly in their unit.
    """

    notes: list[str] = field(default_factory=list)
    short: list[str] = field(default_factory=list)
    repaired: dict[str, dict[str, int]] = field(default_factory=dict)
    unread: dict[str, UnreadableMessages] = field(default_factory=dict)
    lost: dict[str, Counter[str]] = field(default_factory=dict)
    static: dict[str, str] = field(default_factory=dict)
    doubted: dict[str, str] = field(default_factory=dict)

    def pass_over(self, topic: str, reason: str) -> None:
        """Counts a message that cannot be read."""
        known = self.unread.setdefault(topic, UnreadableMessages(0, reason))
        known.count += 1

    def lose(self, topic: str, losses: list[str]) -> None:
        """Counts what a message does not carry over."""
        self.lost.setdefault(topic, Counter()).update(dict.fromkeys(losses, 1))

    def lines(self, called: Callable[[str], str] = str) -> list[str]:
        """Returns everything as lines for people; `called`: what a topic is called in them."""
        found = [*self.notes, *self.short]
        for name, done in self.repaired.items():
            topic = called(name)
            found += [f"{topic}: {_messages(number)} {WORDS[what]}" for what, number in done.items()]
        found += [f"{called(topic)}: {text}" for topic, text in (*self.static.items(), *self.doubted.items())]
        found += [f"{called(topic)}: {unread}" for topic, unread in self.unread.items()]
        for topic, lost in self.lost.items():
            found += [f"{called(topic)}: no place for {text} (in {_messages(number)})" for text, number in lost.items()]
        return found

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "notes": self.notes,
            "missing": self.short,
            "repaired": self.repaired,
            "unread": {topic: {"messages": u.count, "first": u.reason} for topic, u in self.unread.items()},
            "lost": {topic: dict(lost) for topic, lost in self.lost.items()},
            "static": self.static,
            "doubted": self.doubted,
        }


def _messages(number: int) -> str:
    return f"{number:,} message{'' if number == 1 else 's'}"
