"""Mappings of message types to Foxglove protobufs, and the schema of a protobuf as MCAP wants it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError

from dataflow.messages import Message
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.foxglove.values import Fields, Parts

Encode = Callable[[Any], tuple[Parts, tuple[str, ...]]]
Decode = Callable[[Any], Fields]


@dataclass(frozen=True, slots=True)
class FoxgloveSchema:
    """Mapping of one message type to a Foxglove protobuf."""

    message: type[Message]
    proto: type[Any]
    encode: Encode
    decode: Decode
    companion: tuple[str, ...] = ()
    """Every field that may have to go into the companion."""

    @property
    def name(self) -> str:
        return str(self.proto.DESCRIPTOR.full_name)

    def parse(self, data: Any) -> Any:
        """The protobuf object; raises `RecordingError`."""
        return parsed(self.proto, data)


def parsed(proto: type[Any], data: Any) -> Any:
    """An object of a protobuf class; raises `RecordingError`."""
    made = proto()
    try:
        made.ParseFromString(data)
    except DecodeError as error:
        raise RecordingError(f"not a {proto.DESCRIPTOR.full_name}: {error}") from error
    return made


def file_descriptor_set(proto: type[Any]) -> bytes:
    """The self-contained schema of a protobuf class, as MCAP wants it."""
    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(descriptor: Any) -> None:
        if descriptor.name in seen:
            return
        seen.add(descriptor.name)
        for dependency in descriptor.dependencies:
            add(dependency)
        descriptor.CopyToProto(files.file.add())

    add(proto.DESCRIPTOR.file)
    return bytes(files.SerializeToString(deterministic=True))
