"""What a recording holds, at a glance: streams, rates, sizes, firing records, metadata; without decoding anything."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from dataflow.recording.reader import Recording
from dataflow.sync.stamps import format_duration, format_stamp

LONG_VALUE = 60


@dataclass(frozen=True, slots=True)
class StreamSummary:
    """One stream. `rate` in Hz over the stream's own duration; None for fewer than two messages."""

    name: str
    type: str
    schema: str
    encoding: str
    count: int
    rate: float | None
    first: int | None
    last: int | None
    static: bool
    bytes: int
    incarnations: int
    readable: bool
    generic: bool
    declared_otherwise: bool


@dataclass(frozen=True, slots=True)
class Description:
    """What `describe` finds. Stamps and durations in ns; sizes in bytes, `bytes` of the file, of streams uncompressed.

    `start`, `end`, `duration` leave static streams out. `firings` counts batches of records by operator.
    """

    path: str
    bytes: int
    library: str
    profile: str
    torn: bool
    lost_bytes: int
    start: int | None
    end: int | None
    duration: int
    messages: int
    streams: tuple[StreamSummary, ...]
    firings: Mapping[str, int]
    events: Mapping[str, int]
    metadata: Mapping[str, Mapping[str, str]]

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)

    def render(self) -> Group:
        """Tables for a terminal."""
        parts: list[Any] = [self._facts(), self._stream_table()]
        if self.firings:
            parts.append(_counts("firing records", "operator", "batches", self.firings))
        if self.events:
            parts.append(_counts("events", "event", "count", self.events))
        if self.metadata:
            parts.append(self._metadata_table())
        return Group(*parts)

    def _facts(self) -> Table:
        grid = Table.grid(padding=(0, 2))
        size = f"{_size(self.bytes)}, {_size(sum(s.bytes for s in self.streams))} uncompressed"
        grid.add_row("file", Text(self.path))
        grid.add_row("size", size)
        grid.add_row("written by", Text(self.library + (f" (profile {self.profile})" if self.profile else "")))
        if self.start is not None and self.end is not None:
            grid.add_row("from", f"{format_stamp(self.start)} ({self.start})")
            grid.add_row("to", f"{format_stamp(self.end)} ({self.end})")
            grid.add_row("duration", format_duration(self.duration))
        grid.add_row("messages", str(self.messages))
        if self.torn:
            lost = f"; {self.lost_bytes} bytes of an unfinished record are left out" if self.lost_bytes else ""
            grid.add_row("torn", Text(f"the file has no proper end: its writer died{lost}", style="yellow"))
        return grid

    def _stream_table(self) -> Table:
        table = Table(title="streams", title_justify="left")
        for heading in ("stream", "type", "schema", "messages", "rate", "size", ""):
            table.add_column(heading, justify="right" if heading in ("messages", "rate", "size") else "left")
        for s in self.streams:
            notes = ["static"] if s.static else []
            notes += [f"{s.incarnations} incarnations"] if s.incarnations > 1 else []
            notes += [] if s.readable else ["not readable here"]
            notes += ["declared otherwise now"] if s.declared_otherwise else []
            notes += ["type read from the recording"] if s.generic else []
            rate = "" if s.rate is None or s.static else f"{s.rate:.2f} Hz"
            row = (s.name, s.type, f"{s.schema} ({s.encoding})", str(s.count), rate, _size(s.bytes), ", ".join(notes))
            table.add_row(*map(Text, row))
        return table

    def _metadata_table(self) -> Table:
        table = Table(title="metadata", title_justify="left")
        for heading in ("record", "key", "value"):
            table.add_column(heading)
        for name, mapping in self.metadata.items():
            for key, value in mapping.items():
                short = value.splitlines()[0][:LONG_VALUE] if value else ""
                more = f" … ({len(value)} characters)" if short != value else ""
                table.add_row(Text(name), Text(key), Text(short + more))
        return table


def describe(recording: Recording) -> Description:
    """The facts of a recording, from its index and metadata; only its events are read."""
    streams = tuple(_summary(recording, name) for name in recording.streams)
    moving = [s for s in streams if not s.static]
    start = min((s.first for s in moving if s.first is not None), default=None)
    end = max((s.last for s in moving if s.last is not None), default=None)
    events: dict[str, int] = {}
    for event in recording.events():
        events[event.name] = events.get(event.name, 0) + 1
    return Description(
        path=str(recording.path),
        bytes=os.stat(recording.path).st_size,
        library=recording.library,
        profile=recording.profile,
        torn=recording.torn,
        lost_bytes=recording.lost_bytes,
        start=start,
        end=end,
        duration=0 if start is None or end is None else end - start,
        messages=sum(s.count for s in streams),
        streams=streams,
        firings=recording.firing_batches(),
        events=dict(sorted(events.items())),
        metadata=recording.metadata,
    )


def _summary(recording: Recording, name: str) -> StreamSummary:
    info = recording.streams[name]
    span = 0 if info.first is None or info.last is None else info.last - info.first
    return StreamSummary(
        name=name,
        type=info.message_type.SCHEMA if info.message_type else info.metadata.get("message_type", ""),
        schema=info.schema,
        encoding=info.encoding,
        count=info.count,
        rate=(info.count - 1) / (span / 1e9) if info.count > 1 and span > 0 else None,
        first=info.first,
        last=info.last,
        static=info.static,
        bytes=info.bytes,
        incarnations=info.incarnations,
        readable=info.message_type is not None,
        generic=info.generic,
        declared_otherwise=info.declared_otherwise,
    )


def _counts(title: str, name: str, number: str, counts: Mapping[str, int]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column(name)
    table.add_column(number, justify="right")
    for key, count in counts.items():
        table.add_row(Text(key), str(count))
    return table


def _size(count: int) -> str:
    value = float(count)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.2f} GB"
