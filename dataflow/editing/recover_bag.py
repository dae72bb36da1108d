"""Writes what was saved of a broken ROS bag as an MCAP file."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from mcap.writer import CompressionType, Writer

from dataflow.editing.recover import LostMessages, RecoveryReport
from dataflow.editing.report import WrittenFile
from dataflow.interop.salvage import salvage
from dataflow.interop.typestores import RosType
from dataflow.recording.errors import RecordingError
from dataflow.recording.mcap.packing import Compression
from dataflow.recording.streams.codecs import SchemaText

_COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


def recover_bag(path: Path, out: Path, *, compression: Compression = "zstd") -> RecoveryReport:
    """Saves a broken SQLite or ROS 1 bag. Raises `RecordingError` for what is neither, or holds no whole message."""
    found = salvage(path)
    topics = dict(found.topics())
    held = [topic for topic in topics.values() if topic.count]
    if not held:
        raise RecordingError(f"{path}: no whole message is left in it")
    counts: Counter[int] = Counter()
    with out.open("wb") as file:
        writer = Writer(file, compression=_COMPRESSIONS[compression])
        writer.start(profile="ros1" if found.encoding == "ros1" else "ros2", library="dataflow recover")
        channels = {}
        for number, topic in topics.items():
            if topic.count:
                text = _defined(topic.schema, found.encoding)
                schema = writer.register_schema(text.name, text.encoding, text.data) if text.name else 0
                channels[number] = writer.register_channel(topic.name, found.encoding, schema, dict(topic.channel))
        for time, number, data in found.rows(list(channels)):
            writer.add_message(channels[number], time, data, time, counts[number] % 2**32)
            counts[number] += 1
        writer.finish()  # type: ignore[no-untyped-call]
    found.close()
    span = min(t.first for t in held if t.first is not None), max(t.last for t in held if t.last is not None)
    saved: Counter[str] = Counter()
    for number, count in counts.items():
        saved[topics[number].name] += count
    lost = [LostMessages("", found.lost, None)] if found.lost else []
    edited = WrittenFile(str(out), dict(sorted(saved.items())), out.stat().st_size, span)
    return RecoveryReport(edited, True, 0, found.notes, lost)


def _defined(schema: SchemaText, encoding: str) -> SchemaText:
    """The definition that the bag has, or the usual one."""
    if schema.data or not schema.name:
        return schema
    try:
        return RosType(schema.name, encoding, schema).as_ros2()
    except RecordingError:
        return SchemaText(schema.name, "ros2msg", b"")
