"""Recordings of our own, from bags: adapted streams, and untouched topics as they are."""

from __future__ import annotations

from pathlib import Path

from dataflow.interop.export.extras import Extras, tell_runs
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource, distinct
from dataflow.recording import RecordingWriter
from dataflow.recording.layout import BAG
from dataflow.recording.mcap.attachments import tells_of_run


def export_own(source: ExportSource, file: Path, done: Exported, *, overwrite: bool = False) -> None:
    """Writes a recording: every stream as its message type, topics that nothing here reads byte for byte.

    Static messages of a bag, which may be stamped by another clock, get the stamp of the first other message.
    """
    with RecordingWriter(file, metadata={}, overwrite=overwrite) as writer:
        names = distinct(source.streams, _plain, [t.name for t in source.untouched])
        source.account.notes += [
            f"topic {name} is the stream {called}, since {_plain(name)} is taken"
            for name, called in names.items()
            if called != _plain(name)
        ]
        for name, info in source.streams.items():
            assert info.message_type is not None
            writer.add_stream(
                names[name], info.message_type, static=info.static, extra={"topic": name, "type": info.schema}
            )
        for topic in source.untouched:
            writer.add_untouched(topic.name, topic.encoding, topic.schema, topic.channel)
        numbers: dict[str, int] = {}
        begin = source.first_stamp()
        for recorded in source.messages():
            seq = numbers.get(recorded.stream, 0)
            placed = source.foreign and begin is not None and source.streams[recorded.stream].static
            message = recorded.message.replace(stamp=begin) if placed else recorded.message
            writer.write(names[recorded.stream], message, seq=seq)
            numbers[recorded.stream] = seq + 1
            done.count(names[recorded.stream])
        for stored in source.stored([t.name for t in source.untouched]):
            writer.write_untouched(stored.topic, stored.log_time, bytes(stored.data))
            done.count(stored.topic)
        if source.foreign:
            writer.add_metadata(BAG, source.facts())
        _carry(source, writer, done)
    done.files.append(str(file))


def _plain(topic: str) -> str:
    return topic.strip("/") or topic


def _carry(source: ExportSource, writer: RecordingWriter, done: Exported) -> None:
    """Takes over attachments and metadata; names that a recording gives a meaning to get the file's in front."""
    extras = Extras(source)
    for name, values in extras.metadata:
        writer.add_metadata(f"{source.path.stem}/{name}" if tells_of_run(name) else name, values)
        done.metadata += 1
    for found in extras.attachments():
        writer.add_attachment(found)
        done.attachments += 1
    tell_runs(extras, done)
