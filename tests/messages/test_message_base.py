"""The base of every message: canonical form, immutability, digest, errors."""

from __future__ import annotations

import copy
import pickle
import struct

import numpy as np
import numpy.typing as npt
import pytest
import xxhash
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.messages import Message, MessageError, array, message_type, message_types, scalar


class Probe(Message, schema="tests.Probe"):
    """One field of each kind."""

    flag: bool = scalar("bool", "a flag", default=False)
    number: int = scalar("int", "a count", default=0)
    real: float = scalar("float", "a length, metres", default=0)
    text: str = scalar("str", "some text", default="")
    words: tuple[str, ...] = scalar("strs", "some words", default=())
    mode: str = scalar("str", "one of two", default="on", choices=("on", "off"))
    note: str | None = scalar("str", "perhaps a note", default=None)
    points: npt.NDArray[np.float32] = array("float32", "N 3", "points", unit="m")
    ids: npt.NDArray[np.int32] | None = array("int32", "N", "identity of each point", default=None)
    image: npt.NDArray[np.uint8] | None = array("uint8", "H W 3|H W", "pixels", default=None)
    level: npt.NDArray[np.uint8 | np.uint16] | None = array("uint8|uint16", "K", "levels", default=None)


POINTS = np.arange(6, dtype=np.float32).reshape(2, 3)


def test_digest_is_xxh3_over_the_documented_bytes() -> None:
    message = Probe(stamp=7, real=-0.0, words=("é", ""), points=POINTS, ids=[4, 5])
    schema = b"tests.Probe"
    expected = struct.pack("<I", len(schema)) + schema + struct.pack("<q", 7)
    expected += b"F" + b"i" + struct.pack("<q", 0) + b"f" + struct.pack("<d", -0.0)
    expected += b"s" + struct.pack("<I", 0)
    expected += b"l" + struct.pack("<I", 2) + struct.pack("<I", 2) + "é".encode() + struct.pack("<I", 0)
    expected += b"s" + struct.pack("<I", 2) + b"on" + b"n"
    expected += b"\x01<f4" + struct.pack("<B2q", 2, 2, 3) + POINTS.tobytes()
    expected += b"\x01<i4" + struct.pack("<B1q", 1, 2) + struct.pack("<2i", 4, 5)
    expected += b"\x00" + b"\x00"
    assert message.digest() == xxhash.xxh3_128(expected).digest()


@pytest.mark.parametrize(
    "given_points",
    [
        POINTS.tolist(),
        POINTS.astype(np.float64),
        POINTS.astype(">f4"),
        np.asfortranarray(POINTS),
        np.repeat(POINTS, 2, axis=0)[::2],
        POINTS.astype(np.int64),
        tuple(map(tuple, POINTS)),
    ],
    ids=["list", "float64", "big-endian", "fortran", "strided", "integers", "tuples"],
)
def test_equal_values_have_equal_digests_however_they_are_given(given_points: object) -> None:
    message = Probe(stamp=1, points=given_points)
    assert message.points.dtype.str == "<f4"
    assert message.points.flags.c_contiguous
    assert message == Probe(stamp=1, points=POINTS)
    assert hash(message) == hash(Probe(stamp=1, points=POINTS))


def test_scalars_take_the_declared_python_type() -> None:
    message = Probe(
        stamp=np.int64(3), flag=np.True_, number=np.uint8(4), real=2, words=["a", "b"], text=np.str_("t"), points=POINTS
    )
    assert [type(v) for v in (message.stamp, *message.header()[:5])] == [int, bool, int, float, str, tuple]
    assert (
        message.digest()
        == Probe(stamp=3, flag=True, number=4, real=2.0, words=("a", "b"), text="t", points=POINTS).digest()
    )


def test_a_default_is_canonical_like_a_given_value() -> None:
    assert type(Probe(stamp=0, points=POINTS).real) is float
    assert Probe(stamp=0, points=POINTS) == Probe(stamp=0, points=POINTS, real=0.0)


def test_a_wrong_default_is_refused_when_it_is_declared() -> None:
    with pytest.raises(MessageError, match="'three' is not a int"):
        scalar("int", "x", default="three")
    with pytest.raises(MessageError, match="'c' is not a str of"):
        scalar("str", "x", default="c", choices=("a", "b"))


def test_negative_zero_and_nan_payloads_count() -> None:
    quiet, payload = np.array([0x7FC00000, 0x7FC00001], np.uint32).view(np.float32)
    variants = [0.0, -0.0, quiet, payload, -quiet]
    digests = {Probe(stamp=0, points=np.array([[v, 0, 0]], np.float32)).digest() for v in variants}
    assert len(digests) == len(variants)
    assert Probe(stamp=0, real=0.0, points=POINTS) != Probe(stamp=0, real=-0.0, points=POINTS)


def test_none_empty_and_other_shapes_differ() -> None:
    empty = np.zeros((0, 3), np.float32)
    messages = [
        Probe(stamp=0, points=empty),
        Probe(stamp=0, points=empty, ids=[]),
        Probe(stamp=0, points=empty, image=np.zeros((2, 3), np.uint8)),
        Probe(stamp=0, points=empty, image=np.zeros((3, 2), np.uint8)),
        Probe(stamp=0, points=empty, image=np.zeros((2, 1, 3), np.uint8)),
        Probe(stamp=0, points=empty, level=np.zeros(2, np.uint8)),
        Probe(stamp=0, points=empty, level=np.zeros(1, np.uint16)),
        Probe(stamp=0, points=empty, note=""),
        Probe(stamp=0, points=empty, words=("",)),
        Probe(stamp=0, points=empty, words=("ab", "c")),
        Probe(stamp=0, points=empty, words=("a", "bc")),
    ]
    assert len({m.digest() for m in messages}) == len(messages)


def test_a_message_does_not_follow_the_array_it_was_made_from() -> None:
    source = POINTS.copy()
    message = Probe(stamp=0, points=source)
    before = message.digest()
    source[:] = 99
    assert message.compute_digest() == before
    assert np.array_equal(message.points, POINTS)


def test_a_message_cannot_be_changed() -> None:
    message = Probe(stamp=0, points=POINTS)
    with pytest.raises(AttributeError, match=r"immutable; use replace\(stamp="):
        message.stamp = 1
    with pytest.raises(AttributeError, match="immutable"):
        del message.text
    with pytest.raises(ValueError, match="read-only"):
        message.points[0, 0] = 1


def test_replace_changes_only_the_named_fields() -> None:
    message = Probe(stamp=0, text="a", points=POINTS)
    changed = message.replace(text="b")
    assert (changed.text, changed.stamp, message.text) == ("b", 0, "a")
    assert changed.replace(text="a") == message


def test_copies_and_pickles_stay_frozen_and_equal() -> None:
    message = Probe(stamp=0, text="a", points=POINTS)
    for twin in (copy.copy(message), copy.deepcopy(message), pickle.loads(pickle.dumps(message))):
        assert twin == message
        assert not twin.points.flags.writeable


def test_compute_digest_notices_a_change_of_frozen_memory() -> None:
    message = Probe(stamp=0, points=POINTS)
    before = message.digest()
    message.points.flags.writeable = True
    message.points[0, 0] += 1
    assert message.digest() == before
    assert message.compute_digest() != before


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({"points": [[1, 2]]}, r"Probe\.points must have shape \(N, 3\), got \(1, 2\)"),
        ({"points": None}, r"Probe\.points is required \(float32 array of shape \(N, 3\)"),
        ({"points": "abc"}, r"Probe\.points must be a float32 array"),
        ({"points": [[1, 2], [3]]}, r"Probe\.points must be a float32 array"),
        ({"points": np.zeros((1, 3), complex)}, r"Probe\.points must be float32, got an array of complex128"),
        ({"ids": [1]}, r"Probe\.ids has N=1, but points has N=2: they must be parallel"),
        ({"ids": [1.5, 2.0]}, r"Probe\.ids must be int32, got an array of float64"),
        ({"ids": np.array([1, 2**40])}, r"Probe\.ids must be int32, got int64 with values that do not fit: 1 to 1099"),
        ({"ids": [1, 2**40]}, r"Probe\.ids must be a int32 array"),
        ({"image": np.zeros((2, 2, 4), np.uint8)}, r"Probe\.image must have shape \(H, W, 3\) or \(H, W\)"),
        ({"level": np.zeros(2, np.int32)}, r"Probe\.level must be uint8 or uint16, got an array of int32"),
        ({"flag": 1}, r"Probe\.flag must be a bool"),
        ({"number": True}, r"Probe\.number must be a int"),
        ({"number": 2**63}, r"Probe\.number must be a int"),
        ({"number": 1.0}, r"Probe\.number must be a int"),
        ({"real": "1"}, r"Probe\.real must be a float"),
        ({"text": 5}, r"Probe\.text must be a str \(some text\), got 5 \(int\)"),
        ({"text": "\ud800"}, r"Probe\.text must be a str"),
        ({"text": None}, r"Probe\.text must be a str, got None"),
        ({"words": "abc"}, r"Probe\.words must be a sequence of str"),
        ({"words": ["a", 1]}, r"Probe\.words must be a sequence of str"),
        ({"mode": "dim"}, r"Probe\.mode must be one of on, off, got 'dim'"),
        ({"colour": 1}, r"Probe has no field 'colour'; its fields: stamp, flag"),
        ({"stamp": 1.5}, r"Probe\.stamp must be an integer \(nanoseconds"),
        ({"stamp": True}, r"Probe\.stamp must be an integer"),
        ({"stamp": 2**63 - 1}, r"Probe\.stamp 9223372036854775807 is outside"),
    ],
)
def test_error_names_the_field_and_the_expected_value(values: dict[str, object], error: str) -> None:
    with pytest.raises(MessageError, match=error):
        Probe(**({"stamp": 0, "points": POINTS} | values))


def test_field_cannot_shadow_a_message_attribute() -> None:
    with pytest.raises(MessageError, match=r"Hiding\.digest: every message has 'digest' already"):
        type("Hiding", (Message,), {"digest": scalar("str", "x")})


def test_a_schema_name_is_declared_once() -> None:
    with pytest.raises(MessageError, match=r"'tests\.Probe' is declared twice"):
        type("Other", (Message,), {}, schema="tests.Probe")
    assert message_type("tests.Probe") is Probe
    assert message_types()["tests.Probe"] is Probe
    with pytest.raises(MessageError, match=r"unknown message schema 'Imgae'; known: .*Image"):
        message_type("Imgae")


def test_shape_symbols_are_checked_when_they_are_declared() -> None:
    with pytest.raises(MessageError, match="'n' is neither a number nor a capitalised symbol"):
        array("float32", "n 3", "x")


def test_from_parts_keeps_the_arrays_without_a_copy() -> None:
    message = Probe(stamp=5, text="t", points=POINTS, ids=[1, 2])
    again = Probe.from_parts(message.stamp, message.header(), message.arrays())
    assert again == message
    assert again.points is message.points


def test_from_parts_refuses_unfrozen_arrays_and_other_forms() -> None:
    message = Probe(stamp=5, points=POINTS)
    header, arrays = message.header(), message.arrays()
    with pytest.raises(MessageError, match="takes 7 header fields and 4 arrays, got 6 and 4"):
        Probe.from_parts(5, header[1:], arrays)
    with pytest.raises(MessageError, match=r"Probe\.points: a decoded array must be frozen"):
        Probe.from_parts(5, header, (POINTS.copy(), *arrays[1:]))
    other = POINTS.astype(np.float64)
    other.flags.writeable = False
    with pytest.raises(MessageError, match=r"Probe\.points: a decoded array must be .* float32, got float64"):
        Probe.from_parts(5, header, (other, *arrays[1:]))
    with pytest.raises(MessageError, match=r"Probe\.points is required"):
        Probe.from_parts(5, header, (None, *arrays[1:]))
    with pytest.raises(MessageError, match=r"Probe\.text is required, got None"):
        Probe.from_parts(5, (*header[:3], None, *header[4:]), arrays)


def test_repr_is_short_and_gives_shapes() -> None:
    text = repr(Probe(stamp=5, points=np.zeros((1000, 3), np.float32)))
    assert text.startswith("Probe(stamp=5, flag=False")
    assert "points=float32[1000, 3]" in text
    assert "ids" not in text
    assert len(text) < 200


@given(st.floats(), st.floats(), st.integers(-(2**63) + 1, 2**63 - 2))
@settings(max_examples=100, deadline=None)
def test_two_messages_are_equal_exactly_when_their_bits_are(a: float, b: float, stamp: int) -> None:
    same = struct.pack("<d", a) == struct.pack("<d", b)
    assert (Probe(stamp=stamp, real=a, points=[]) == Probe(stamp=stamp, real=b, points=[])) == same


@given(st.lists(st.text(), max_size=4), st.lists(st.text(), max_size=4))
@settings(max_examples=100, deadline=None)
def test_different_lists_of_strings_are_unequal(a: list[str], b: list[str]) -> None:
    assert (Probe(stamp=0, words=a, points=[]) == Probe(stamp=0, words=b, points=[])) == (a == b)
