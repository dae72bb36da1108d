"""Copies of recordings in which something was changed: what a fault, or somebody, may do to a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from dataflow.messages import Message
from dataflow.recording import Recorded, Recording, RecordingWriter
from dataflow.recording.layout import OUTCOME, RESERVED_METADATA
from dataflow.records.firing import FiringRecord, consecutive, encode_batch
from dataflow.records.reading import FiringLog

Kept = Iterable[tuple[Message, int]]
"""The messages, with their numbers, that take the place of one."""


def as_it_is(found: Recorded) -> Kept:
    return [(found.message, found.seq)]


def tampered(
    path: Path,
    out: Path,
    *,
    messages: Callable[[Recorded], Kept] = as_it_is,
    records: Callable[[FiringRecord], bool] = lambda record: True,
    batches: Callable[[str, bytes], bytes] = lambda operator, payload: payload,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
) -> Path:
    """Writes a copy: `messages` says what becomes of each message, `records` which firing records stay."""
    with Recording(path) as recording:
        kept = {n: dict(v) for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
        kept |= {name: dict(values) for name, values in (metadata or {}).items()}
        with RecordingWriter(out, metadata=kept, namespace=recording.metadata["recording"]["namespace"]) as writer:
            for name, info in recording.streams.items():
                assert info.message_type is not None
                extra = {key: info.metadata[key] for key in ("operator", "port") if key in info.metadata}
                writer.add_stream(name, info.message_type, static=info.static, extra=extra)
                for found in recording.messages([name]):
                    for message, seq in messages(found):
                        writer.write(name, message, seq=seq, incarnation=found.incarnation)
            log = FiringLog.read(recording)
            for operator in log.operators:
                for batch in consecutive(record for record in log.of(operator) if records(record)):
                    writer.write_firings(operator, max(batch[-1].stamp, 1), batches(operator, encode_batch(batch)))
    return out


def duplicated(path: Path, out: Path, stream: str, seq: int) -> Path:
    """Writes a copy, as another program might, in which one message stands twice."""
    with path.open("rb") as source, out.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        summary = reader.get_summary()
        assert summary is not None
        writer.start(profile="", library="another program")
        schemas = {i: writer.register_schema(s.name, s.encoding, s.data) for i, s in summary.schemas.items()}
        channels = {
            i: writer.register_channel(c.topic, c.message_encoding, schemas.get(c.schema_id, 0), dict(c.metadata))
            for i, c in summary.channels.items()
        }
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, dict(record.metadata))
        for _, channel, message in reader.iter_messages(log_time_order=False):
            for _ in range(2 if (channel.topic, message.sequence) == (stream, seq) else 1):
                writer.add_message(
                    channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
        writer.finish()
    return out


def ended(outcome: str) -> dict[str, dict[str, str]]:
    """The metadata of a run that ended in another way."""
    return {OUTCOME: {"outcome": outcome}}
