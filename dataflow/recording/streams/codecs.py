"""Codecs between message types and MCAP messages: Foxglove protobuf with a companion, or JSON."""

from __future__ import annotations

import json
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import xxhash

from dataflow.messages.base import ArrayField, Field, Message, MessageError, is_built_in
from dataflow.messages.declaration import Declaration
from dataflow.recording.errors import RecordingError
from dataflow.recording.layout import FIELDS
from dataflow.recording.streams.foxglove import FOXGLOVE_SCHEMAS, FoxgloveSchema, Parts, file_descriptor_set
from dataflow.recording.streams.json_codec import (
    NONE,
    TIMESTAMP,
    decode_fields,
    decode_object,
    encode_fields,
    encode_object,
    json_schema,
    timestamp_object,
)
from dataflow.recording.streams.json_columns import Values, decode_json_columns

M = TypeVar("M", bound=Message)


@dataclass(frozen=True, slots=True)
class SchemaText:
    """A schema as it stands in a file."""

    name: str
    encoding: str
    data: bytes


class Codec(Protocol):
    """Turns the messages of one type into bytes and back, without loss."""

    @property
    def message_encoding(self) -> str: ...

    @property
    def schema(self) -> SchemaText: ...

    @property
    def companion_schema(self) -> SchemaText | None:
        """The schema of the companion, where the type may need one."""

    def encode(self, message: Any) -> tuple[Parts, bytes | None]:
        """The parts of the data, and the companion's data where this message needs one."""

    def decode(self, stamp: int, data: Any, companion: Any | None) -> Message:
        """The message back; raises `RecordingError`."""

    def fields(self, data: Any, companion: Any | None, names: Collection[str]) -> dict[str, Any]:
        """The named fields alone, those that are None left out: canonical scalars and frozen arrays.

        Cheaper than the message, which checks them together. Raises `RecordingError`.
        """

    def columns(self, messages: Sequence[tuple[Any, Any | None]], names: Collection[str]) -> dict[str, Values]:
        """The named fields of many messages, each given as data and companion. Raises `RecordingError`."""


class JsonCodec(Generic[M]):
    """Any message type as JSON."""

    message_encoding = "json"
    companion_schema = None

    def __init__(self, message: type[M]) -> None:
        self._message = message

    @cached_property
    def schema(self) -> SchemaText:
        message = self._message
        return SchemaText(f"dataflow.{message.SCHEMA}", "jsonschema", json_schema(message, message.FIELDS))

    def encode(self, message: M) -> tuple[Parts, bytes | None]:
        fields = encode_fields(message, self._message.FIELDS)
        return [encode_object({TIMESTAMP: timestamp_object(message.stamp)} | fields)], None

    def decode(self, stamp: int, data: Any, companion: Any | None) -> M:
        return build(self._message, stamp, decode_fields(decode_object(data), self._message.FIELDS))

    def fields(self, data: Any, companion: Any | None, names: Collection[str]) -> dict[str, Any]:
        return decode_fields(decode_object(data), [f for f in self._message.FIELDS if f.name in names])

    def columns(self, messages: Sequence[tuple[Any, Any | None]], names: Collection[str]) -> dict[str, Values]:
        fields = [f for f in self._message.FIELDS if f.name in names]
        return decode_json_columns((data for data, _ in messages), fields)


class FoxgloveCodec(Generic[M]):
    """A well-known message type as Foxglove protobuf; what that lacks as a JSON companion."""

    message_encoding = "protobuf"

    def __init__(self, message: type[M], schema: FoxgloveSchema) -> None:
        self._message, self._mapping = message, schema
        self._fields = {f.name: f for f in message.FIELDS}
        self._companion: tuple[Field, ...] = tuple(self._fields[name] for name in schema.companion)

    @cached_property
    def schema(self) -> SchemaText:
        return SchemaText(self._mapping.name, "protobuf", file_descriptor_set(self._mapping.proto))

    @cached_property
    def companion_schema(self) -> SchemaText | None:
        if not self._companion:
            return None
        data = json_schema(self._message, self._companion, companion_of=self._mapping.name)
        return SchemaText(f"dataflow.{self._message.SCHEMA}.companion", "jsonschema", data)

    def encode(self, message: M) -> tuple[Parts, bytes | None]:
        parts, lacks = self._mapping.encode(message)
        if not lacks:
            return parts, None
        companion: dict[str, Any] = {TIMESTAMP: timestamp_object(message.stamp)}
        companion |= encode_fields(message, (self._fields[name] for name in lacks))
        none = [name for name in lacks if message.__dict__[name] is None]
        if none:
            companion[NONE] = none
        return parts, encode_object(companion)

    def decode(self, stamp: int, data: Any, companion: Any | None) -> M:
        return build(self._message, stamp, self._decoded(data, companion))

    def fields(self, data: Any, companion: Any | None, names: Collection[str]) -> dict[str, Any]:
        found = self._decoded(data, companion)
        return {name: found[name] for name in names if found.get(name) is not None}

    def columns(self, messages: Sequence[tuple[Any, Any | None]], names: Collection[str]) -> dict[str, Values]:
        found = [self._decoded(data, companion) for data, companion in messages]
        return {name: [fields.get(name) for fields in found] for name in names}

    def _decoded(self, data: Any, companion: Any | None) -> dict[str, Any]:
        fields = self._mapping.decode(self._mapping.parse(data))
        if companion is not None:
            extra = decode_object(companion)
            fields |= decode_fields(extra, self._companion)
            fields |= dict.fromkeys(extra.get(NONE, ()), None)
        return fields


def build(message: type[M], stamp: int, fields: Mapping[str, Any]) -> M:
    """A message of canonical scalars and frozen arrays by name; absent ones are None. Raises `RecordingError`."""
    header = [fields.get(f.name) for f in message.SCALARS]
    arrays = [fields.get(f.name) for f in message.ARRAYS]
    try:
        return message.from_parts(stamp, header, arrays)
    except (MessageError, AttributeError, TypeError) as error:
        raise RecordingError(f"not a valid {message.SCHEMA}: {error}") from error


_codecs: dict[type[Message], Codec] = {}
_codecs_lock = threading.Lock()


def codec_for(message: type[Message]) -> Codec:
    """The codec of a message type: Foxglove protobuf for the well-known ones, else JSON."""
    with _codecs_lock:
        codec = _codecs.get(message)
        if codec is None:
            well_known = FOXGLOVE_SCHEMAS.get(message)
            codec = JsonCodec(message) if well_known is None else FoxgloveCodec(message, well_known)
            _codecs[message] = codec
        return codec


def declaration_metadata(message: type[Message]) -> dict[str, str]:
    """Returns a channel's metadata on its message type: a digest of the declaration, and the whole declaration for an
    own type."""
    declared = {"declaration": declaration_digest(message)}
    if not is_built_in(message):
        declared[FIELDS] = json.dumps(Declaration.of(message).to_json(), ensure_ascii=False)
    return declared


def recorded_declaration(metadata: Mapping[str, str]) -> Declaration | None:
    """The declaration that a stream's channel holds; None where it holds none that can be read."""
    try:
        return Declaration.from_json(json.loads(metadata[FIELDS]))
    except (KeyError, ValueError, RecursionError):
        return None


def declaration_digest(message: type[Message]) -> str:
    """16 hex digits that change when the names, kinds, dtypes or shapes of a type's fields change, later ones aside."""
    words = [message.SCHEMA]
    for field in message.FIELDS:
        if field.added:
            continue
        kind = f"{field.dtype_text()} {field.shape_text()}" if isinstance(field, ArrayField) else field.kind
        words.append(f"{field.name}: {kind}{' | None' if field.optional else ''}")
    return xxhash.xxh3_64_hexdigest("\n".join(words).encode())
