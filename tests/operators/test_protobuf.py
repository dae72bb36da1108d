"""Fields of protobuf messages: as protobuf's own package writes them."""

from __future__ import annotations

import pytest
from google.protobuf.struct_pb2 import Struct
from google.protobuf.timestamp_pb2 import Timestamp

from operators.protobuf import field, fields, number_field


def test_fields_are_written_as_protobuf_writes_them() -> None:
    for size in (0, 1, 127, 128, 300, 20_000):
        text = "ä" * size
        written = Struct()
        written.fields["key"].string_value = text
        entry = field(1, b"key") + field(2, field(3, text.encode()))
        assert field(1, entry) == written.SerializeToString()
    for seconds in (1, 127, 128, 2**40):
        assert number_field(1, seconds) == Timestamp(seconds=seconds).SerializeToString()


def test_fields_read_are_those_written() -> None:
    written = Struct()
    for k in range(5):
        written.fields[f"key {k}"].number_value = k / 3  # 8 bytes of fixed size
        written.fields[f"text {k}"].string_value = "x" * 100 * k
    message = written.SerializeToString() + number_field(77, 2**50)
    read = list(fields(message))
    assert b"".join(each.serialized for each in read) == message
    assert [each.number for each in read] == [1] * 10 + [77]
    keys = [next(fields(each.content)).content.decode() for each in read[:-1]]
    assert sorted(keys) == sorted(written.fields)


@pytest.mark.parametrize(
    ("message", "told"),
    [
        (b"\x0a\x05abc", "field 1 at byte 0 ends after the message of 5 bytes"),
        (b"\x09\x01", "field 1 at byte 0 ends after"),
        (b"\x0a\xff", "begins no number"),
        (b"\x80" * 12, "begins no number"),
        (b"\x0b", "byte 0 begins no field .*: its kind is 3"),  # a group, which protobuf no longer writes
    ],
)
def test_malformed_message_is_refused(message: bytes, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        list(fields(message))
