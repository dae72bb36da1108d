"""The result of an export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from dataflow.recording.errors import RecordingError

Watch = Callable[[int], None]
"""Is told the number of messages written."""


@dataclass(slots=True)
class Exported:
    """Messages written by stream or topic, files written, and what was left out with the reason.

    `attachments`, `metadata`: how many of an MCAP file's were carried over. `lost`: by stream, what a format has no
    room for, and in how many messages. `lossy`: whether values may be written with fewer bits than they have.
    """

    written: dict[str, int] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    attachments: int = 0
    metadata: int = 0
    lost: dict[str, dict[str, int]] = field(default_factory=dict)
    lossy: bool = False
    watch: Watch | None = None

    def count(self, name: str) -> None:
        """One more message of a stream."""
        self.written[name] = self.written.get(name, 0) + 1
        if self.watch is not None:
            self.watch(sum(self.written.values()))

    def lose(self, name: str, what: str, number: int = 1) -> None:
        """Messages of a stream, or values in them, that the format does not hold wholly."""
        known = self.lost.setdefault(name, {})
        known[what] = known.get(what, 0) + number

    def narrow(self, name: str, what: str) -> None:
        """As `lose`, of values that would get fewer bits: raises `RecordingError` unless that is asked for."""
        if not self.lossy:
            raise RecordingError(f"{name}: {what}; --lossy writes it all the same")
        self.lose(name, what)

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {name: value for name, value in asdict(self).items() if name not in ("watch", "lossy")}
