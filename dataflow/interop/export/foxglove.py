"""Foxglove MCAP: every stream that a Foxglove schema fits as protobuf, others as JSON with their schema."""

from __future__ import annotations

from pathlib import Path

from mcap.writer import CompressionType, Writer

from dataflow.foxglove.drawing import data_of, drawing_of, schema_of
from dataflow.interop.export.extras import carry
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource, distinct
from dataflow.messages import Message
from dataflow.recording.streams.foxglove import FOXGLOVE_SCHEMAS


def export_foxglove(source: ExportSource, file: Path, done: Exported) -> None:
    """Writes an MCAP for Foxglove: topics named `/node/port`, log time and the messages' own time the stamp.

    Fields that a Foxglove schema has no place for are counted and left out (our recordings keep them in companions).
    """
    with file.open("wb") as opened:
        writer = Writer(opened, compression=CompressionType.ZSTD)
        writer.start(profile="", library="dataflow convert")
        channels: dict[tuple[str, str], int] = {}
        called = distinct(source.names.values(), _topic, [t.name for t in source.untouched])
        kept: dict[str, int] = {}
        for topic in source.untouched:
            schema = writer.register_schema(topic.schema.name, topic.schema.encoding, topic.schema.data)
            kept[topic.name] = writer.register_channel(topic.name, topic.encoding, schema if topic.schema.name else 0)
        for recorded in source.messages():
            stamp, message = max(recorded.stamp, 0), recorded.message
            place = (recorded.stream, schema_of(message)[0].name)
            if place not in channels:
                channels[place] = _open(writer, called[source.names[recorded.stream]], message)
            known = FOXGLOVE_SCHEMAS.get(type(message))
            for field in () if known is None else known.encode(message)[1]:
                if field == "precise":
                    done.narrow(source.names[recorded.stream], "points of 64 bits, of which 32 are written")
                elif not isinstance(value := getattr(message, field), str | None) or value:
                    done.lose(source.names[recorded.stream], field)
            if (drawn := drawing_of(message)) is not None:
                what = drawn.proto.DESCRIPTOR.full_name
                done.lose(source.names[recorded.stream], f"what a {what}, as which it is drawn, does not show")
            writer.add_message(channels[place], stamp, data_of(message), stamp, recorded.seq % 2**32)
            done.count(source.names[recorded.stream])
        for stored in source.stored(list(kept)):
            writer.add_message(
                kept[stored.topic], stored.log_time, bytes(stored.data), stored.log_time, stored.number % 2**32
            )
            done.count(stored.topic)
        carry(source, writer, done)
        writer.finish()  # type: ignore[no-untyped-call]
    done.files.append(str(file))


def _topic(name: str) -> str:
    return f"/{name.lstrip('/')}"


def _open(writer: Writer, topic: str, message: Message) -> int:
    schema, encoding = schema_of(message)
    number = writer.register_schema(schema.name, schema.encoding, schema.data)
    return writer.register_channel(topic, encoding, number)
