"""Recordings in few lines: of messages, and as other programs write them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from dataflow.messages import Message, Pose
from dataflow.recording import RecordingWriter


def pose(stamp: int, x: float = 0.0) -> Pose:
    return Pose(stamp=stamp, frame="map", position=[x, 0.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0])


def noise(seed: int, *shape: int) -> Any:
    """Pixels that do not compress."""
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def recorded(path: Path, rows: Iterable[tuple[str, Message]], *, static: Iterable[str] = (), **options: Any) -> Path:
    """A recording of (stream, message) rows, which are numbered stream by stream."""
    rows, seqs = list(rows), dict[str, int]()
    with RecordingWriter(path, overwrite=True, **{"metadata": {}, **options}) as writer:
        for stream, message in rows:
            if stream not in seqs:
                writer.add_stream(stream, type(message), static=stream in static)
                seqs[stream] = -1
        for stream, message in rows:
            seqs[stream] += 1
            writer.write(stream, message, seq=seqs[stream])
    return path


def of_robot(path: Path, streams: Mapping[str, Iterable[Message]], static: Iterable[str] = ()) -> Path:
    """A recording of robot1, stream after stream."""
    rows = [(f"robot1/{name}", message) for name, messages in streams.items() for message in messages]
    return recorded(path, rows, static=[f"robot1/{name}" for name in static], namespace="robot1")


def foreign(
    path: Path,
    *topics: tuple[str, str, tuple[str, str, bytes] | None, Iterable[tuple[int, bytes]]],
    profile: str = "",
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    of_channels: Mapping[str, str] | None = None,
    **options: Any,
) -> Path:
    """A file of another program: topics with their encoding, schema and (time, bytes) of messages."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile=profile, library="another program")
        for topic, encoding, schema, messages in topics:
            number = 0 if schema is None else writer.register_schema(*schema)
            channel = writer.register_channel(topic, encoding, number, dict(of_channels or {}))
            for sequence, (time, data) in enumerate(messages):
                writer.add_message(channel, time, data, time, sequence)
        for name, values in (metadata or {}).items():
            writer.add_metadata(name, dict(values))
        writer.finish()
    return path
