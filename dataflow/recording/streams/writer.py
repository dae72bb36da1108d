"""Writes a recording: streams of messages, firing records and events, in one MCAP file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from dataflow.messages.base import Message
from dataflow.messages.digest import StreamDigest
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import (
    COMPANION_SUFFIX,
    DIGESTS,
    EVENT_SCHEMA,
    FORMAT,
    RECORDING,
    RESERVED_METADATA,
    SEQUENCE_SPAN,
    Kind,
    events_topic,
    firings_topic,
    library,
    logs_topic,
)
from dataflow.recording.mcap.attachments import Attachment
from dataflow.recording.mcap.container import CHUNK_BYTES, CHUNK_SECONDS, ContainerWriter
from dataflow.recording.mcap.packing import Buffer, Compression
from dataflow.recording.parts import OWNER_ONLY
from dataflow.recording.streams.codecs import Codec, SchemaText, codec_for, declaration_metadata
from dataflow.recording.streams.frames import FrameChannel
from dataflow.recording.streams.json_codec import TIMESTAMP, encode_object, timestamp_object
from dataflow.recording.streams.logs import SCHEMA as LOG_SCHEMA
from dataflow.recording.streams.logs import SCHEMA_NAME as LOG_SCHEMA_NAME
from dataflow.recording.streams.logs import LogLine
from dataflow.sync.stamps import FOREVER


@dataclass(slots=True)
class _Stream:
    name: str
    message: type[Message]
    codec: Codec
    metadata: dict[str, str]
    schema: int
    static: bool
    channel: int = 0
    companion: int = 0
    incarnation: int = -1
    sequence_base: int = -1
    last_seq: int = -1
    last_stamp: int = -1
    digest: StreamDigest = field(default_factory=StreamDigest)


class RecordingWriter:
    """Writes one recording. Not thread-safe; a context manager.

    What was added before `flush()` survives the death of this process, and so does every chunk that filled up or was
    `chunk_seconds` old when the next message came: a recorder calls `flush()` when nothing came for that long.
    Memory holds two chunks, one of messages and one of firing records and events. A failed write (full disk) raises
    `RecordingError`, then and at every later call.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        namespace: str = "",
        compression: Compression = "zstd",
        chunk_bytes: int = CHUNK_BYTES,
        chunk_seconds: float = CHUNK_SECONDS,
        overwrite: bool = False,
        mode: int = OWNER_ONLY,
    ) -> None:
        self._file = ContainerWriter(
            Path(path),
            library=library(),
            compression=compression,
            chunk_bytes=chunk_bytes,
            chunk_seconds=chunk_seconds,
            overwrite=overwrite,
            mode=mode,
        )
        self._namespace = namespace
        self._streams: dict[str, _Stream] = {}
        self._run: dict[str, tuple[int, int]] = {}
        """Channels of the run's records by topic, and how many each has."""
        self._untouched: dict[str, tuple[int, int]] = {}
        self._newest = 0
        self._frames = FrameChannel(self._file, namespace)
        try:
            self._file.add_metadata(RECORDING, {"format": FORMAT, "namespace": namespace})
            for name, mapping in metadata.items():
                self.add_metadata(name, mapping)
        except BaseException:
            self._file.close()
            raise

    @property
    def path(self) -> Path:
        """The file."""
        return self._file.path

    @property
    def closed(self) -> bool:
        """Returns whether it was closed."""
        return self._file.closed

    @property
    def saved_bytes(self) -> int:
        """Bytes that are in the file now; the unfinished chunk is not."""
        return self._file.saved_bytes

    @property
    def given_bytes(self) -> int:
        """Bytes that are in the file, and in the unfinished chunk before it is compressed."""
        return self._file.given_bytes

    @property
    def failed(self) -> bool:
        """Returns whether a write has failed: nothing more can be added."""
        return self._file.failed

    def saved(self, stream: str) -> int:
        """Messages of a stream that are in the file now."""
        return self._file.saved(stream)

    def add_stream(
        self, stream: str, message_type: type[Message], *, static: bool = False, extra: Mapping[str, str] | None = None
    ) -> None:
        """Declares a stream. `extra` joins the channel's metadata (operator, port).

        Raises `RecordingError` for a stream declared twice.
        """
        if stream in self._streams:
            raise RecordingError(f"{self.path}: stream {stream!r} is declared twice")
        codec = codec_for(message_type)
        metadata = {
            "kind": Kind.STREAM,
            "message_type": message_type.SCHEMA,
            "static": "true" if static else "false",
        } | declaration_metadata(message_type)
        clash = metadata.keys() & (extra or {}).keys()
        if clash:
            raise RecordingError(f"{self.path}: stream {stream!r}: extra must not set {', '.join(sorted(clash))}")
        added = _Stream(stream, message_type, codec, metadata | dict(extra or {}), self._schema(codec.schema), static)
        self._streams[stream] = added
        self._open_channel(added, 0, 0)

    def write(self, stream: str, message: Message, *, seq: int, incarnation: int = 0) -> None:
        """Adds a message of a declared stream. Stamps and sequence numbers strictly increase within an incarnation.

        Raises `RecordingError`: an unknown stream, another type than declared, a negative stamp, a stamp or number
        that does not increase (nothing is written then), or a disk that refuses.
        """
        known = self._streams.get(stream)
        if known is None:
            names = ", ".join(sorted(self._streams)) or "none"
            raise RecordingError(f"{self.path}: stream {stream!r} is not declared; declared are: {names}")
        self._check(known, message, seq, incarnation)
        parts, extra = known.codec.encode(message)
        base = seq - seq % SEQUENCE_SPAN
        if (incarnation, base) != (known.incarnation, known.sequence_base):
            self._open_channel(known, incarnation, base)
        stamp, sequence = message.stamp, seq - base
        group: list[tuple[int, int, int, list[Buffer]]] = [(known.channel, stamp, sequence, list(parts))]
        if extra is not None:
            group.append((self._companion(known), stamp, sequence, [extra]))
        self._file.add_messages([*group, *self._frames.derived(stream, message)])
        known.last_seq, known.last_stamp = seq, stamp
        known.digest.update(message.digest())
        self._newest = max(self._newest, stamp)

    def add_untouched(self, topic: str, encoding: str, schema: SchemaText, metadata: Mapping[str, str]) -> None:
        """Declares a topic of another program whose messages are kept as they are."""
        if topic in self._untouched:
            raise RecordingError(f"{self.path}: topic {topic!r} is declared twice")
        others = {key: value for key, value in metadata.items() if key != "kind"}
        self._untouched[topic] = (self._file.add_channel(topic, encoding, self._schema(schema), others), 0)

    def write_untouched(self, topic: str, log_time: int, data: bytes) -> None:
        """Adds a message of such a topic, byte for byte."""
        channel, count = self._untouched[topic]
        self._file.add_messages([(channel, log_time, count % SEQUENCE_SPAN, [data])])
        self._untouched[topic] = (channel, count + 1)

    def write_firings(self, operator: str, stamp: int, payload: bytes) -> None:
        """Adds a batch of firing records of one operator, as the runtime encoded them (msgpack).

        A `stamp` that is no time (the epoch or before it, or forever) is logged at the newest time so far.
        """
        topic, metadata = firings_topic(self._namespace, operator), {"kind": Kind.FIRINGS, "operator": operator}
        self._record(topic, "msgpack", SchemaText("", "", b""), metadata, self._log_time(stamp), payload)

    def write_event(self, name: str, stamp: int, mapping: Mapping[str, Any]) -> None:
        """Adds an event of the run (a gap, an incarnation, a fault) as JSON. `mapping` holds JSON values.

        A `stamp` that is no time (the epoch or before it, or forever) is logged at the newest time so far.
        """
        log_time = self._log_time(stamp)
        body = {TIMESTAMP: timestamp_object(log_time), "event": name, "stamp": str(stamp), "data": dict(mapping)}
        try:
            data = encode_object(body)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{self.path}: event {name!r} does not hold JSON values only: {error}") from error
        schema = SchemaText("dataflow.Event", "jsonschema", EVENT_SCHEMA)
        self._record(events_topic(self._namespace), "json", schema, {"kind": Kind.EVENTS}, log_time, data)

    def write_log(self, stamp: int, line: LogLine) -> None:
        """Adds a line of the log. A `stamp` that is no time is logged at the newest time so far."""
        log_time = self._log_time(stamp)
        data = encode_object({TIMESTAMP: timestamp_object(log_time), **line.recorded()})
        schema = SchemaText(LOG_SCHEMA_NAME, "jsonschema", LOG_SCHEMA)
        self._record(logs_topic(self._namespace), "json", schema, {"kind": Kind.LOGS}, log_time, data)

    def _record(
        self, topic: str, encoding: str, schema: SchemaText, metadata: Mapping[str, str], log_time: int, data: bytes
    ) -> None:
        """Adds a record of the run to the channel of a topic, which is declared with the first."""
        channel, count = self._run.get(topic) or (
            self._file.add_channel(topic, encoding, self._schema(schema), metadata),
            0,
        )
        self._file.add_record(channel, log_time, count % SEQUENCE_SPAN, data)
        self._run[topic] = channel, count + 1

    def add_metadata(self, name: str, mapping: Mapping[str, str]) -> None:
        """Adds a metadata record, now or later; of one name and key the latest counts."""
        if name in RESERVED_METADATA:
            raise RecordingError(f"{self.path}: metadata {name!r} is written by the recording itself; use another name")
        self._file.add_metadata(name, mapping)

    def add_attachment(self, attachment: Attachment) -> None:
        """Adds a file inside the recording."""
        self._file.add_attachment(attachment)

    def digests(self) -> Mapping[str, str]:
        """Stream digest of everything written so far, by stream."""
        return {name: stream.digest.hexdigest() for name, stream in sorted(self._streams.items())}

    def flush(self) -> None:
        """Hands everything added so far to the operating system: it survives `kill -9` of this process."""
        self._file.finish_chunks()

    def close(self) -> None:
        """Writes what is left, the stream digests and the index. Idempotent."""
        if self._file.closed:
            return
        try:
            self._file.finish_chunks()
            self._file.add_metadata(DIGESTS, self.digests())
            self._file.finish_chunks()  # where there is no room for it, there may be for the index
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RecordingError:
            if not isinstance(value, RecordingError):
                raise

    def _check(self, stream: _Stream, message: Message, seq: int, incarnation: int) -> None:
        where = f"{self.path}: stream {stream.name!r}"
        if type(message) is not stream.message:
            raise RecordingError(f"{where} holds {stream.message.SCHEMA}, got {type(message).__name__}")
        if message.stamp < 0:
            raise RecordingError(
                f"{where}: stamp {message.stamp} is before the epoch; MCAP times are unsigned, so stamps must be ≥ 0"
            )
        if seq < 0:
            raise RecordingError(f"{where}: sequence number {seq} must be ≥ 0")
        if incarnation < stream.incarnation:
            raise RecordingError(f"{where}: incarnation {incarnation} after {stream.incarnation}; they never go back")
        if incarnation == stream.incarnation and (seq <= stream.last_seq or message.stamp <= stream.last_stamp):
            raise RecordingError(
                f"{where}: message {seq} at stamp {message.stamp} after message {stream.last_seq} at stamp "
                f"{stream.last_stamp}: both must increase within incarnation {incarnation}"
            )

    def _schema(self, schema: SchemaText) -> int:
        return self._file.add_schema(schema.name, schema.encoding, schema.data) if schema.name else 0

    def _open_channel(self, stream: _Stream, incarnation: int, base: int) -> None:
        """The channel of one incarnation of a stream, and of 2^32 of its sequence numbers."""
        metadata = stream.metadata | {"incarnation": str(incarnation)} | _base(base)
        stream.channel = self._file.add_channel(stream.name, stream.codec.message_encoding, stream.schema, metadata)
        stream.companion = 0
        if incarnation != stream.incarnation:
            stream.last_seq = stream.last_stamp = -1
        stream.incarnation, stream.sequence_base = incarnation, base

    def _companion(self, stream: _Stream) -> int:
        if not stream.companion:
            schema = stream.codec.companion_schema
            assert schema is not None, f"{stream.message.SCHEMA} has a companion without a schema"
            metadata = {
                "kind": Kind.COMPANION,
                "companion_of": stream.name,
                "message_type": stream.message.SCHEMA,
                "incarnation": str(stream.incarnation),
            } | _base(stream.sequence_base)
            topic = stream.name + COMPANION_SUFFIX
            stream.companion = self._file.add_channel(topic, "json", self._schema(schema), metadata)
        return stream.companion

    def _log_time(self, stamp: int) -> int:
        if not 0 < stamp < FOREVER:
            return self._newest
        self._newest = max(self._newest, stamp)
        return stamp


def _base(base: int) -> dict[str, str]:
    return {"sequence_base": str(base)} if base else {}
