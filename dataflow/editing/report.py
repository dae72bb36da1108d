"""Reports what became of a recording that was edited."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
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
    `unknown`: operators whose state at the cut is not in the recording. `notes` tell what else is to
    be known, for people.
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
    notes: list[str] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """All messages of streams."""
        return sum(self.streams.values())

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self) | {"messages": self.messages}
