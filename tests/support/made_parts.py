"""Parts of recordings, cut at seconds, and what recordings hold."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dataflow.editing.part import Part, write_part
from dataflow.recording import Recording
from dataflow.recording.streams.copying import Origin

SECOND = 1_000_000_000


def cut(path: Path, out: Path, start: float | None, end: float | None, **options: bool) -> Path:
    """Cuts at seconds from the first message."""
    with Origin(path) as origin:
        span = origin.span()
        assert span is not None
        begin, finish = (None if s is None else span[0] + round(s * SECOND) for s in (start, end))
        write_part(origin, Part(begin, finish, **options), out)
    return out


def messages(path: Path) -> Mapping[str, Mapping[tuple[int, int], bytes]]:
    with Recording(path) as recording:
        return {
            name: {(m.incarnation, m.seq): m.message.digest() for m in recording.messages([name])}
            for name in recording.streams
        }
