"""MCAP files of other programs, written by the `mcap` library."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from mcap.writer import Writer


def foreign_mcap(
    path: Path,
    messages: Iterable[tuple[str, int, bytes]],
    *,
    profile: str = "",
    library: str = "another program",
    schema: str = "",
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    attachments: Iterable[tuple[str, str, int, int, bytes]] = (),
) -> Path:
    """Writes messages (topic, log time, JSON), numbered by topic, with a schema of that name if it has one;
    `attachments`: name, media type, log time, creation time and content."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile=profile, library=library)
        kind = writer.register_schema(schema, "jsonschema", b"{}") if schema else 0
        for name, media, log_time, created, data in attachments:
            writer.add_attachment(created, log_time, name, media, data)
        channels: dict[str, int] = {}
        numbers: dict[str, int] = {}
        for topic, time, data in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", kind)
            numbers[topic] = numbers.get(topic, -1) + 1
            writer.add_message(channels[topic], time, data, time, numbers[topic])
        for name, values in (metadata or {}).items():
            writer.add_metadata(name, dict(values))
        writer.finish()
    return path
