"""One result of a look at the machine."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum


class State(StrEnum):
    """The seriousness of a finding."""

    OK = "ok"
    NOTE = "note"
    """Something optional is not there."""
    WARNING = "warning"
    """Graphs run, and something will be slow or wrong."""
    FAULT = "fault"
    """Graphs do not run."""


@dataclass(frozen=True, slots=True)
class Finding:
    """`about` names what was looked at, `text` the result, `hint` what would mend it."""

    group: str
    about: str
    state: State
    text: str
    hint: str = ""

    def to_json(self) -> dict[str, str]:
        return {key: str(value) for key, value in asdict(self).items()}
