"""Reports what became of a recording that was edited."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataflow.recording.streams.copying import Origin

Watch = Callable[[int, int], None]
"""Is told how many messages of how many are copied."""


def unwatched(done: int, total: int) -> None:
    """Takes no notice."""


@dataclass(slots=True)
class WrittenFile:
    """One file that was written.

    `streams`: messages by stream; `span`: first and last stamp of what is not static (ns). `beyond`: messages outside
    of the span that was asked for, which its firings took or made, and `lead` the stamp of the first firing that is
    repeated for it. `attachments`: how many files inside of it.
    `lost`: by stream, messages that damage has kept from being read; `lacking`: missing parts of the files
    that it was made of, whose messages are not counted anywhere. `unknown`: operators whose state at the cut is not
    in the recording. `notes` hold what else users need to know.
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
    lacking: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def lose(self, origin: Origin) -> None:
        """Notes the damage of a file that was copied, and counts its messages that could not be read."""
        for stream, number in origin.lost.items():
            self.lost[stream] = self.lost.get(stream, 0) + number
            self.notes.append(f"{origin.path}: {stream}: {number:,} messages lost to damage: {origin.reasons[stream]}")
        self.lacking += origin.file.lacking
        self.notes += origin.file.lacking
        self.notes += [f"{origin.path}: {note}" for note in origin.file.damage]

    @property
    def messages(self) -> int:
        """All messages of streams."""
        return sum(self.streams.values())

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self) | {"messages": self.messages}
