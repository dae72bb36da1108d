"""The part of a recording that a file holds: from what, and which span."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

from dataflow.recording.layout import CUT, FLIGHT


@dataclass(frozen=True, slots=True)
class Cut:
    """Names what a part was cut from: the file's name, and the span (stamps in ns, inclusive; None: not cut there).

    Messages before `start` and after `end` may be in it where firings in the span took them.
    """

    of: str
    start: int | None
    end: int | None

    def metadata(self) -> dict[str, str]:
        """The values of its metadata record."""
        span = {"start": self.start, "end": self.end}
        return {"of": self.of} | {name: str(stamp) for name, stamp in span.items() if stamp is not None}


def cut_of(metadata: Mapping[str, Mapping[str, str]]) -> Cut | None:
    """The cut that a recording is, by its metadata; None for a whole one."""
    found = metadata.get(CUT)
    if found is None:
        return None
    return Cut(found.get("of", ""), _stamp(found.get("start", "")), _stamp(found.get("end", "")))


def triggers_of(metadata: Mapping[str, Mapping[str, str]]) -> list[str]:
    """Why a flight recorder kept the recording, in words; empty where none did."""
    try:
        found = json.loads(metadata.get(FLIGHT, {}).get("triggers", "[]"))
    except ValueError:
        return []
    told = found if isinstance(found, list) else []
    return [str(one["what"]) for one in told if isinstance(one, dict) and "what" in one]


def _stamp(text: str) -> int | None:
    return int(text) if text.removeprefix("-").isdecimal() else None
