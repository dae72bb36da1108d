"""Writes what was saved of a broken ROS bag as an MCAP file."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from mcap.writer import CompressionType, Writer

from dataflow.editing.recover import Loss, Recovered
from dataflow.editing.report import Edited
from dataflow.interop.salvage import salvage
from dataflow.interop.typestores import RosType
from dataflow.recording.codecs import SchemaText
from dataflow.recording.errors import RecordingError


def recover_bag(path: Path, out: Path) -> Recovered:
    """Saves a broken SQLite or ROS 1 bag. Raises `RecordingError` for what is neither, or holds no whole message."""
    found = salvage(path)
    if not found.messages:
        raise RecordingError(f"{path}: no whole message is left in it")
    with out.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros1" if found.encoding == "ros1" else "ros2", library="dataflow recover")
        channels = {}
        for topic, schema in found.schemas.items():
            text = _defined(schema, found.encoding)
            number = writer.register_schema(text.name, text.encoding, text.data) if text.name else 0
            channels[topic] = writer.register_channel(topic, found.encoding, number)
        counts: Counter[str] = Counter()
        for topic, time, data in found.messages:
            writer.add_message(channels[topic], time, data, time, counts[topic] % 2**32)
            counts[topic] += 1
        writer.finish()  # type: ignore[no-untyped-call]
    times = [message.log_time for message in found.messages]
    saved = Edited(str(out), dict(sorted(counts.items())), out.stat().st_size, (min(times), max(times)))
    lost = [Loss("", found.lost, None)] if found.lost else []
    return Recovered(saved, True, 0, found.notes, lost)


def _defined(schema: SchemaText, encoding: str) -> SchemaText:
    """The definition that the bag has, or the usual one."""
    if schema.data or not schema.name:
        return schema
    try:
        return RosType(schema.name, encoding, schema).as_ros2()
    except RecordingError:
        return SchemaText(schema.name, "ros2msg", b"")
