"""Lines of a run's log: what operators log and print, as they are recorded and shown.

In a recording they lie in one JSON channel whose schema is Foxglove's Log, with fields of our own beside it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

LEVELS: Final = ("debug", "info", "warning", "error", "fatal")
"""From the least to the most serious."""
SCHEMA_NAME: Final = "foxglove.Log"


@dataclass(frozen=True, slots=True)
class LogLine:
    """One line, or several of one call of a logger."""

    level: str
    text: str
    process: str = ""
    operator: str = ""
    """Empty where the operator of the process is unknown."""
    stamp: int | None = None
    """Event time (ns) of the call in which it was said; None outside of calls, and in `setup()`."""
    time: int = 0
    """Wall time, ns since the epoch."""
    source: str = ""
    """The logger's name; `stdout` and `stderr` for what was printed; empty for what comes from outside of Python."""
    file: str = ""
    line: int = 0

    @property
    def severity(self) -> int:
        """0 for debug, 4 for fatal."""
        return LEVELS.index(self.level)

    @property
    def name(self) -> str:
        """The operator, or else the process."""
        return self.operator or self.process

    def to_json(self) -> dict[str, Any]:
        """JSON values, without those that say nothing."""
        return {key: value for key, value in asdict(self).items() if value not in ("", 0, None)}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> LogLine:
        """Raises `ValueError`, `KeyError`, `TypeError` for what is no line."""
        level = str(value["level"])
        if level not in LEVELS:
            raise ValueError(f"no level: {level!r}")
        stamp = value.get("stamp")
        texts = {key: str(value.get(key, "")) for key in ("text", "process", "operator", "source", "file")}
        return cls(
            level=level,
            stamp=None if stamp is None else int(stamp),
            time=int(value.get("time", 0)),
            line=int(value.get("line", 0)),
            **texts,
        )

    def recorded(self) -> dict[str, Any]:
        """The fields of its JSON message, the timestamp aside: Foxglove's, and ours. 64-bit numbers are texts."""
        return {
            "level": self.severity + 1,
            "message": self.text,
            "name": self.name,
            "file": self.file,
            "line": self.line,
            "process": self.process,
            "operator": self.operator,
            "source": self.source,
            "stamp": "" if self.stamp is None else str(self.stamp),
            "time": str(self.time),
        }

    @classmethod
    def of_recorded(cls, value: Mapping[str, Any]) -> LogLine:
        """Raises `ValueError`, `KeyError`, `TypeError`, `IndexError` for what is no line."""
        return cls(
            level=LEVELS[max(int(value["level"]), 1) - 1],
            text=str(value["message"]),
            process=str(value["process"]),
            operator=str(value["operator"]),
            stamp=int(value["stamp"]) if value["stamp"] else None,
            time=int(value["time"]),
            source=str(value["source"]),
            file=str(value["file"]),
            line=int(value["line"]),
        )


_TEXTS = {
    "message": "what was said",
    "name": "the operator, or else the process",
    "file": "source file of the call of the logger",
    "process": "the process of the run",
    "operator": "the operator; empty where it is not known",
    "source": "the logger; stdout or stderr for what was printed",
    "stamp": "event time of the operator's call, nanoseconds since the epoch; empty outside of calls",
    "time": "wall time, nanoseconds since the epoch",
}
SCHEMA: Final = json.dumps(
    {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": SCHEMA_NAME,
        "description": "a line of the log",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
            "level": {"type": "integer", "description": "1 debug, 2 info, 3 warning, 4 error, 5 fatal"},
            **{name: {"type": "string", "description": text} for name, text in _TEXTS.items()},
            "line": {"type": "integer", "description": "line in that file"},
        },
        "required": ["timestamp", "level", "message", "name", "file", "line"],
    },
    indent=1,
).encode()
