"""One thing that was found in a recording, and all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["note", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """`check` names what was looked for; `values` holds its figures by name, units in the names."""

    check: str
    stream: str
    severity: Severity
    text: str
    at: int | None = None
    """The first stamp (ns) at which it shows."""
    values: Mapping[str, float | int | str] | None = None

    def to_json(self) -> dict[str, Any]:
        return {key: value for key, value in asdict(self).items() if value is not None}
