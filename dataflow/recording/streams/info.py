"""Describes a recording at a glance: streams, rates, sizes, firing records, metadata; without decoding anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from dataflow.recording.streams.reader import Recording


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


_SAME = (
    *("name", "schema", "encoding", "count", "first", "last", "static", "bytes", "incarnations"),
    *("generic", "declared_otherwise"),
)
"""Facts that a summary takes over as they are."""


@dataclass(frozen=True, slots=True)
class AttachmentSummary:
    """One file that the recording carries."""

    name: str
    media_type: str
    bytes: int


@dataclass(frozen=True, slots=True)
class Description:
    """Result of `describe`. Stamps and durations in ns; sizes in bytes, `bytes` of the file, of streams uncompressed.

    `start`, `end`, `duration` leave static streams out. `firings` counts batches of records by operator. `damage` notes
    what is damaged. Text is as in the file: for a terminal, `dataflow.recording.visible` escapes it.
    """

    path: str
    bytes: int
    library: str
    profile: str
    torn: bool
    lost_bytes: int
    damage: tuple[str, ...]
    start: int | None
    end: int | None
    duration: int
    messages: int
    streams: tuple[StreamSummary, ...]
    firings: Mapping[str, int]
    events: Mapping[str, int]
    attachments: tuple[AttachmentSummary, ...]
    metadata: Mapping[str, Mapping[str, str]]

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def describe(recording: Recording) -> Description:
    """The facts of a recording, from its index and metadata; only its events and attachments are read."""
    streams = tuple(_summary(recording, name) for name in recording.streams)
    moving = [s for s in streams if not s.static]
    start = min((s.first for s in moving if s.first is not None), default=None)
    end = max((s.last for s in moving if s.last is not None), default=None)
    attachments = tuple(AttachmentSummary(a.name, a.media_type, len(a.data)) for a in recording.attachments())
    events: dict[str, int] = {}
    for event in recording.events():
        events[event.name] = events.get(event.name, 0) + 1
    return Description(
        path=str(recording.path),
        bytes=recording.nbytes,
        library=recording.library,
        profile=recording.profile,
        torn=recording.torn,
        lost_bytes=recording.lost_bytes,
        damage=recording.damage,
        start=start,
        end=end,
        duration=0 if start is None or end is None else end - start,
        messages=sum(s.count for s in streams),
        streams=streams,
        firings=recording.firing_batches(),
        events=dict(sorted(events.items())),
        attachments=attachments,
        metadata=recording.metadata,
    )


def _summary(recording: Recording, name: str) -> StreamSummary:
    info = recording.streams[name]
    span = 0 if info.first is None or info.last is None else info.last - info.first
    return StreamSummary(
        type=info.message_type.SCHEMA if info.message_type else info.metadata.get("message_type", ""),
        rate=(info.count - 1) / (span / 1e9) if info.count > 1 and span > 0 else None,
        readable=info.message_type is not None,
        **{same: getattr(info, same) for same in _SAME},
    )
