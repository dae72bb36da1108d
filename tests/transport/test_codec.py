"""The envelope codec: lossless, zero-copy, and unimpressed by hostile bytes."""

from __future__ import annotations

import struct
import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from transport_envelopes import carrying

from dataflow.messages import Message, array, scalar
from dataflow.transport import codec
from dataflow.transport.codec import decode, decode_head, encode
from dataflow.transport.envelope import ALIGNMENT, MAGIC, PRELUDE, VERSION, DecodeError, Envelope, Kind, Limits


class CodecSample(Message):
    """Every kind of field."""

    flag: bool = scalar("bool", "a flag")
    count: int = scalar("int", "a count")
    value: float = scalar("float", "a value")
    name: str = scalar("str", "a name")
    words: tuple[str, ...] = scalar("strs", "words")
    note: str | None = scalar("str", "a note", optional=True)
    labels: tuple[str, ...] | None = scalar("strs", "labels", optional=True)
    points: np.ndarray[Any, Any] = array("float32|float64", "N 3", "points")
    mask: np.ndarray[Any, Any] | None = array("bool", "N", "a mask", optional=True)
    pixels: np.ndarray[Any, Any] | None = array("uint8", "H W 3|H W", "pixels", optional=True)


def sample(stamp: int = 7, **changes: Any) -> CodecSample:
    values: dict[str, Any] = {
        "flag": True,
        "count": -3,
        "value": 0.5,
        "name": "näme",
        "words": ("a", "", "ü"),
        "points": np.arange(6, dtype=np.float32).reshape(2, 3),
        "mask": [True, False],
        "pixels": np.arange(24, dtype=np.uint8).reshape(2, 4, 3),
    }
    return CodecSample(stamp=stamp, **(values | changes))


def message_envelope(message: Message | None = None) -> Envelope:
    return carrying(message or sample(), "robot1/camera/image", 5, incarnation=1, wall=123)


def forged(body: bytes, payload: bytes = b"", *, kind: int = Kind.MESSAGE) -> bytes:
    head = msgpack.packb(("a/b/c", 0, 0, 7, 0, ""))
    return PRELUDE.pack(MAGIC, VERSION, kind, len(head), len(body)) + head + body + payload


texts = st.text(max_size=20)
int64 = st.integers(-(2**63), 2**63 - 1)


@st.composite
def samples(draw: st.DrawFn) -> CodecSample:
    n = draw(st.integers(0, 5))
    dtype = draw(st.sampled_from(["<f4", "<f8"]))
    raw = draw(st.binary(min_size=n * 3 * int(dtype[2]), max_size=n * 3 * int(dtype[2])))
    return CodecSample(
        stamp=draw(st.integers(-(2**62), 2**62)),
        flag=draw(st.booleans()),
        count=draw(int64),
        value=draw(st.binary(min_size=8, max_size=8).map(lambda b: struct.unpack("<d", b)[0])),
        name=draw(texts),
        words=draw(st.lists(texts, max_size=4)),
        note=draw(st.none() | texts),
        labels=draw(st.none() | st.lists(texts, max_size=3)),
        points=np.frombuffer(raw, dtype).reshape(n, 3),
        mask=draw(st.none() | st.lists(st.booleans(), min_size=n, max_size=n)),
        pixels=draw(st.none() | st.sampled_from([(0, 4), (2, 3), (3, 5, 3)]).map(lambda s: np.ones(s, np.uint8))),
    )


@given(samples(), st.integers(0, 2**63 - 1), st.integers(0, 2**31))
@settings(max_examples=100, deadline=None)
def test_a_message_survives_bit_for_bit(message: CodecSample, seq: int, incarnation: int) -> None:
    envelope = carrying(message, "robot1/camera/image", seq, incarnation, wall=17)
    decoded = decode(encode(envelope))
    assert decoded.message is not None
    assert decoded.message.compute_digest() == message.compute_digest()
    assert (decoded.seq, decoded.incarnation, decoded.stamp, decoded.wall) == (seq, incarnation, message.stamp, 17)


def test_nan_payloads_and_negative_zero_survive() -> None:
    odd_nan = struct.unpack("<d", bytes.fromhex("010000000000f87f"))[0]
    points = np.array([[0xFFC00001, 0x80000000, 0x7FC00000]], np.uint32).view(np.float32)
    for value in (odd_nan, -0.0, float("-inf")):
        message = sample(value=value, points=points, mask=None)
        decoded = decode(encode(message_envelope(message))).message
        assert decoded is not None
        assert decoded.compute_digest() == message.compute_digest()
    assert sample(value=0.0).digest() != sample(value=-0.0).digest()  # the digest does see the difference


@pytest.mark.parametrize(
    "envelope",
    [
        Envelope(Kind.FRONTIER, "r/a/b", 0, 9, 2**63 - 2),
        Envelope(Kind.END, "r/a/b", 2, 9, -(2**63), reason="end of source"),
        Envelope(Kind.PROBE, "r/a/b", 0, 12, 0, wall=5),
    ],
    ids=lambda e: e.kind.name,
)
def test_envelopes_without_a_message_survive(envelope: Envelope) -> None:
    assert decode(encode(envelope)) == envelope


def test_arrays_are_aligned_read_only_views_of_the_buffer() -> None:
    wire = encode(message_envelope())
    start = np.frombuffer(wire, np.uint8).__array_interface__["data"][0]
    message = decode(wire).message
    assert message is not None
    for data in message.arrays():
        assert data is not None
        offset = data.__array_interface__["data"][0] - start
        assert 0 <= offset < len(wire)
        assert offset % ALIGNMENT == 0
        assert not data.flags.writeable
    with pytest.raises(ValueError):
        message.arrays()[0].flags.writeable = True


def test_a_kind_that_is_none_is_refused() -> None:
    for kind in (0, 4, 7, 255):
        wire = bytearray(encode(message_envelope()))
        wire[5] = kind
        with pytest.raises(DecodeError, match=f"kind {kind}"):
            decode(wire)


def test_the_head_is_read_without_the_message() -> None:
    wire = bytearray(encode(message_envelope()))
    head_bytes = PRELUDE.unpack_from(wire)[3]
    del wire[PRELUDE.size + head_bytes + 1 :]
    wire[8:12] = bytes(4)
    head = decode_head(bytes(wire))
    assert (head.kind, head.stream, head.seq, head.stamp) == (Kind.MESSAGE, "robot1/camera/image", 5, 7)


@given(st.binary(max_size=300))
@settings(max_examples=300, deadline=None)
def test_arbitrary_bytes_raise_only_decode_error(data: bytes) -> None:
    for wire in (data, MAGIC + data, MAGIC + bytes([VERSION, 1]) + data, forged(data)):
        with pytest.raises(DecodeError):
            decode(wire)


WIRE = encode(message_envelope())


@given(st.data())
@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_mutated_envelopes_decode_or_raise_decode_error(data: st.DataObject) -> None:
    wire = bytearray(WIRE)
    for _ in range(data.draw(st.integers(1, 4))):
        wire[data.draw(st.integers(0, len(wire) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.sampled_from([0, 0, 1, 40, len(wire) // 2]))
    try:
        decoded = decode(bytes(wire[: len(wire) - cut]))
    except DecodeError:
        return
    assert decoded.kind is not Kind.MESSAGE or decoded.message is not None


@pytest.mark.parametrize("cut", range(1, len(WIRE), 7))
def test_a_truncated_envelope_is_refused(cut: int) -> None:
    with pytest.raises(DecodeError):
        decode(WIRE[:-cut])


def test_bytes_after_the_envelope_are_refused() -> None:
    with pytest.raises(DecodeError, match="after the last array"):
        decode(WIRE + b"\0")
    with pytest.raises(DecodeError, match="after the head"):
        decode(encode(Envelope(Kind.FRONTIER, "a/b/c", 0, 0, 0)) + b"\0")


def body_of(descriptors: Any, header: Any = None) -> bytes:
    values = header or (True, 1, 0.5, "n", (), None, None)
    packed: bytes = msgpack.packb(("CodecSample", values, descriptors))
    return packed


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        (msgpack.packb(("NoSuchType", (), ())), "unknown message schema 'NoSuchType'"),
        (msgpack.packb(("CodecSample", (), ())), "header: expected 7 elements, got 0"),
        (msgpack.packb((1, (), ())), "schema must be a string"),
        (body_of((("<i8", (2, 3)), None, None)), "dtype must be '<f4' or '<f8', got '<i8'"),
        (body_of((("<f4", (-1, 3)), None, None)), "shape"),
        (body_of((("<f4", (2**40, 3)), None, None)), "shape"),
        (body_of((("<f4", (2**29, 2**29)), None, None)), "payload bytes, the limit"),
        (body_of((("<f4", (1000, 3)), None, None)), "needs 12000 bytes"),
        (body_of((("<f4", (1,) * 9), None, None)), "9 elements, at most 8"),
        (body_of((("<f4", (0, 3)), ("|b1", (1,)), None), None), "needs 1 bytes"),
        (body_of((None, None, None)), "points is required"),
        (body_of((("<f4", (0, 3)), None, None), (1, 1, 0.5, "n", (), None, None)), "CodecSample.flag must be a bool"),
        (body_of((("<f4", (0, 3)), None, None), (True, 1, 0.5, "n", (1,), None, None)), "words"),
        (body_of((("<f4", (0, 3)), None, None), (True, 1, 0.5, (1, 2), (), None, None)), "name"),
        (body_of((("<f4", (0, 3)), None, None)) + b"\x01", "bytes after the array descriptors"),
        (b"\xdf\xff\xff\xff\xff", "expected an array"),
    ],
)
def test_a_malformed_body_is_explained(body: bytes, complaint: str) -> None:
    with pytest.raises(DecodeError, match=complaint.replace("(", r"\(")) as caught:
        decode(forged(body))
    assert "'a/b/c'" in str(caught.value)


def test_a_bool_that_is_neither_zero_nor_one_is_refused() -> None:
    wire = bytearray(encode(message_envelope(sample(pixels=None))))
    assert wire[-2:] == b"\x01\x00"
    wire[-1] = 2
    with pytest.raises(DecodeError, match="neither 0 nor 1"):
        decode(bytes(wire))


def test_limits_are_enforced() -> None:
    with pytest.raises(DecodeError, match="at most 16 are accepted"):
        decode(WIRE, Limits(body_bytes=16))
    with pytest.raises(DecodeError, match="the limit"):
        decode(WIRE, Limits(payload_bytes=20))
    with pytest.raises(DecodeError, match="words: 3 elements, at most 2"):
        decode(WIRE, Limits(strings=2))
    with pytest.raises(DecodeError, match="head"):
        decode(WIRE, Limits(head_bytes=4))


def nested(length: int, depth: int) -> bytes:
    return b"".join(b"\xdd" + struct.pack(">I", length) for _ in range(depth))


@pytest.mark.parametrize(
    "wire",
    [
        forged(nested(0xFFFFFFFF, 400)),
        forged(nested(60_000, 400) + bytes(60_000)),
        forged(b"\x93\xabCodecSample\x97\xc3\x01\x01\xa1n" + nested(60_000, 400) + bytes(60_000)),
        forged(b"\xdb\xff\xff\xff\xff"),
        forged(b"\xc6\xff\xff\xff\xff"),
        forged(body_of((("<f4", (2**28, 3)), None, None))),
        forged(body_of((("<f4", (2**30, 0)), None, None))),
        PRELUDE.pack(MAGIC, VERSION, 1, 4000, 0) + nested(0xFFFFFFFF, 800),
        PRELUDE.pack(MAGIC, VERSION, 1, 0xFFFF, 0xFFFFFFFF) + bytes(100),
    ],
    ids=lambda wire: wire[12:44].hex(),
)
def test_hostile_lengths_take_no_memory(wire: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(DecodeError):
            decode(wire)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < len(wire) * 4 + 200_000


def test_a_message_and_its_kind_must_agree() -> None:
    with pytest.raises(ValueError, match="FRONTIER"):
        encode(Envelope(Kind.FRONTIER, "a/b/c", 0, 0, 7, sample()))
    with pytest.raises(ValueError, match="stamp 8"):
        encode(Envelope(Kind.MESSAGE, "a/b/c", 0, 0, 8, sample(7)))


def outcome(data: bytes) -> str | bytes:
    """The digest of what is decoded; the error where there is one."""
    try:
        message = decode(data).message
    except DecodeError as error:
        return str(error)
    assert message is not None
    assert not any(held.flags.writeable for held in message.arrays() if held is not None)
    return message.digest()


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_small_body_is_decoded_as_any_other(data: st.DataObject) -> None:
    """As a whole, or value by value: the same messages and the same errors, also where bytes were changed."""
    message = data.draw(st.one_of(samples(), st.just(sample(mask=None)), st.just(sample(mask=None, pixels=None))))
    wire = bytearray(encode(message_envelope(message)))
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(wire) - 1), st.integers(0, 255)), max_size=3)):
        wire[place] = value
    if wire[5] != Kind.MESSAGE:
        return

    whole = outcome(bytes(wire))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "_SMALL_BODY", -1)
        assert outcome(bytes(wire)) == whole


def test_a_body_that_came_before_is_decoded_by_the_class_that_is_asked_for_now() -> None:
    """What a body says is kept, since most of a stream are equal; a class that was declared anew takes its place."""
    wires = [encode(message_envelope(sample(stamp, mask=None, pixels=None))) for stamp in (7, 8)]
    first, second = (decode(wire).message for wire in wires)

    class Anew(Message):
        """The same fields, of another class."""

    Anew.SCHEMA, Anew.SCALARS, Anew.ARRAYS = CodecSample.SCHEMA, CodecSample.SCALARS, CodecSample.ARRAYS
    anew = decode(wires[1], types=lambda schema: Anew).message

    assert first is not None
    assert second is not None
    assert (first.stamp, second.stamp) == (7, 8)
    assert second == sample(8, mask=None, pixels=None)
    assert type(anew) is Anew
    assert type(decode(wires[1]).message) is CodecSample


def test_few_bodies_are_kept() -> None:
    for count in range(3 * codec._MOST_BODIES):
        assert decode(encode(message_envelope(sample(count=count, mask=None, pixels=None)))).message is not None

    assert len(codec._bodies) <= codec._MOST_BODIES
