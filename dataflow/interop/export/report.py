"""The result of an export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

Watch = Callable[[int], None]
"""Is told the number of messages written."""


@dataclass(slots=True)
class Exported:
    """Messages written by stream or topic, files written, and what was left out with the reason.

    `attachments`, `metadata`: how many of an MCAP file's were carried over.
    """

    written: dict[str, int] = field(default_factory=dict)
    files: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    attachments: int = 0
    metadata: int = 0
    watch: Watch | None = None

    def count(self, name: str) -> None:
        """One more message of a stream."""
        self.written[name] = self.written.get(name, 0) + 1
        if self.watch is not None:
            self.watch(sum(self.written.values()))

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {name: value for name, value in asdict(self).items() if name != "watch"}
