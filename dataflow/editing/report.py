"""Reports what became of a recording that was edited."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

Watch = Callable[[int, int], None]
"""Is told how many messages of how many are copied."""


def unwatched(done: int, total: int) -> None:
    """Takes no notice."""


@dataclass(slots=True)
class Edited:
    """One file that was written.

    `streams`: messages by stream; `span`: first and last stamp of what is not static (ns). `beyond`: messages outside
    of the span that was asked for, which its firings took or made, and `lead` the stamp of the first firing that is
    repeated for it. `attachments`: how many files inside of it.
    `lost`: by stream, messages that damage has kept from being read. `unknown`: operators whose state at the cut is not
    in the recording. `notes` tell what else is to be known, for people.
    """

    path: str
    streams: dict[str, int] = field(default_factory=dict)
    bytes: int = 0
    span: tuple[int, int] | None = None
    beyond: int = 0
    lead: int | None = None
    firings: int = 0
    unknown: tuple[str, ...] = ()
    attachments: int = 0
    lost: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def lose(self, path: Path, lost: Mapping[str, int], reasons: Mapping[str, str]) -> None:
        """Takes off the messages of a file that could not be read, and notes them."""
        for stream, number in lost.items():
            self.lost[stream] = self.lost.get(stream, 0) + number
            self.notes.append(f"{path}: {stream}: {number:,} messages lost to damage: {reasons[stream]}")

    @property
    def messages(self) -> int:
        """All messages of streams."""
        return sum(self.streams.values())

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self) | {"messages": self.messages}
