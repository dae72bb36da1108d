"""Decoders for recordings of other programs: a registry, and those of Foxglove schemas, as protobuf or as JSON."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.json_format import ParseDict, ParseError
from google.protobuf.timestamp_pb2 import Timestamp

from dataflow.messages import DepthImage, Image, Image16, Transforms
from dataflow.messages.base import Message
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.codecs import SchemaText, build
from dataflow.recording.streams.foxglove import FOXGLOVE_SCHEMAS, FoxgloveSchema, parsed, stamp_of
from dataflow.recording.streams.foxglove.clouds import CLOUD_FIELDS
from dataflow.recording.streams.json_codec import decode_object
from dataflow.recording.streams.pixels import is_16_bit

DEPTH_ENCODINGS = ("32FC1", "16UC1")
_PREFERRED = {"foxglove.PoseInFrame": "Pose", "foxglove.RawImage": "Image"}
"""The message type of a Foxglove schema that serves several."""


@dataclass(frozen=True, slots=True)
class ForeignDecoder:
    """Reads the messages that other programs wrote with one schema.

    `bind(schema)` is called once per channel with the schema as it stands in the file, and returns the function that
    turns (data, log time) into a message. Its stamp is the one that the data carries, or else the log time.
    """

    bind: Callable[[SchemaText], Callable[[bytes, int], Message]]


_foreign: dict[tuple[str, str], ForeignDecoder] = {}


def register_decoder(message_encoding: str, schema: str, decoder: ForeignDecoder) -> None:
    """Makes streams of (message encoding, schema name), written by other programs, readable as messages."""
    key = (message_encoding, schema)
    if key in _foreign:
        raise RecordingError(f"there is a decoder for {message_encoding} messages of schema {schema!r} already")
    _foreign[key] = decoder


def foreign_decoder(message_encoding: str, schema: SchemaText) -> Callable[[bytes, int], Message] | None:
    """The decoder of a foreign channel, or None where the schema is not known."""
    found = _foreign.get((message_encoding, schema.name))
    return None if found is None else found.bind(schema)


_UNREAD: dict[str, tuple[str, ...]] = {"foxglove.Log": ("file", "line"), "foxglove.LocationFix": ("color",)}
"""By schema, the fields that have no place here."""


def foreign_losses(message_encoding: str, schema: SchemaText, data: bytes) -> list[str]:
    """Names what a message of a Foxglove schema holds that has no place here. Raises `RecordingError`."""
    found = next((s for s in FOXGLOVE_SCHEMAS.values() if s.name == schema.name), None)
    if found is None or message_encoding not in ("protobuf", "json"):
        return []
    proto = found.parse(data) if message_encoding == "protobuf" else _from_json(found.proto, data)
    lost = [field.name for field, _ in proto.ListFields() if field.name in _UNREAD.get(schema.name, ())]
    if isinstance(proto, PointCloud):
        lost += [f"the field {field.name} of the points" for field in proto.fields if field.name not in CLOUD_FIELDS]
    if message_encoding == "json":
        known = {name for field in proto.DESCRIPTOR.fields for name in (field.name, field.json_name)}
        lost += sorted(decode_object(data).keys() - known)
    return lost


def _stamp(proto: Any, log_time: int) -> int:
    """The time that the message carries, or the log time where it carries none."""
    if "timestamp" in proto.DESCRIPTOR.fields_by_name:
        return stamp_of(proto.timestamp) if proto.HasField("timestamp") else log_time
    stamps = [stamp_of(t.timestamp) for t in proto.transforms if t.HasField("timestamp")]
    return max(stamps, default=log_time)


def _message(schema: FoxgloveSchema, proto: Any, log_time: int) -> Message:
    if isinstance(proto, RawImage):
        kind = DepthImage if proto.encoding in DEPTH_ENCODINGS else Image16 if is_16_bit(proto.encoding) else Image
        schema = FOXGLOVE_SCHEMAS[kind]
    return build(schema.message, _stamp(proto, log_time), schema.decode(proto))


def _one_transform(proto: FrameTransform, log_time: int) -> Message:
    """foxglove.FrameTransform: a set of one."""
    return _message(FOXGLOVE_SCHEMAS[Transforms], FrameTransforms(transforms=[proto]), log_time)


def _from_json(kind: type[Any], data: bytes) -> Any:
    value, proto = decode_object(data), kind()
    if not isinstance(value, dict):
        raise RecordingError(f"not a {proto.DESCRIPTOR.full_name}: the JSON is no object, but {type(value).__name__}")
    try:
        ParseDict(_with_proto_times(value), proto, ignore_unknown_fields=True)
    except ParseError as error:
        raise RecordingError(f"not a {proto.DESCRIPTOR.full_name}: {error}") from error
    return proto


def _with_proto_times(value: Any) -> Any:
    """Foxglove's JSON times {"sec", "nsec"} as protobuf's JSON mapping wants them (RFC 3339 text)."""
    if isinstance(value, list):
        return [_with_proto_times(v) for v in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"sec", "nsec"}:
        return _rfc3339(value["sec"], value["nsec"])
    return {key: _with_proto_times(v) for key, v in value.items()}


def _rfc3339(seconds: Any, nanoseconds: Any) -> str:
    try:
        return str(Timestamp(seconds=seconds, nanos=nanoseconds).ToJsonString())
    except (TypeError, ValueError) as error:
        raise RecordingError(f"time {seconds!r} s {nanoseconds!r} ns: {error}") from error


def _register(name: str, kind: type[Any], message: Callable[[Any, int], Message]) -> None:
    """Registers the decoders of a protobuf, as such and as JSON."""
    for encoding, parse in (("protobuf", parsed), ("json", _from_json)):
        decode = partial(_decoded, parse, kind, message)
        register_decoder(encoding, name, ForeignDecoder(lambda _, decode=decode: decode))  # type: ignore[misc]


def _decoded(
    parse: Callable[[type[Any], bytes], Any],
    kind: type[Any],
    message: Callable[[Any, int], Message],
    data: bytes,
    log_time: int,
) -> Message:
    return message(parse(kind, data), log_time)


for _schema in FOXGLOVE_SCHEMAS.values():
    if _PREFERRED.get(_schema.name, _schema.message.SCHEMA) == _schema.message.SCHEMA:
        _register(_schema.name, _schema.proto, partial(_message, _schema))
_register("foxglove.FrameTransform", FrameTransform, _one_transform)
