"""The functions that are made for a message class say what the general ones say, and what the documentation says."""

from __future__ import annotations

import functools
import itertools
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xxhash
from example_messages import example
from messages_page import families

from dataflow.messages import Message, MessageError, array, scalar
from dataflow.messages.fields.compiled_digest import ONE_UPDATE

TYPES = [cls for classes in families().values() for cls in classes]
ODD: list[Any] = [None, True, 3, -(2**70), 2.5, np.float32(2.5), np.int16(7), "text", "größe", "\ud800", ("a", "b")]
ODD += [["a", 1], [], object(), np.zeros((2, 3), np.float32), np.zeros((2, 3), ">f8"), np.zeros((2, 4))]
ODD += [np.zeros((3, 2), np.float32).T, np.ones((2, 2), np.uint8), np.ones(2, np.int64), np.zeros(0, np.int32)]
ODD += [np.zeros((0, 3)), np.zeros((2, 3), bool)]


def documented_digest(message: Message) -> bytes:
    """The digest by its documentation, field by field."""
    schema = message.SCHEMA.encode()
    data = struct.pack("<I", len(schema)) + schema + struct.pack("<q", message.stamp)
    for spec in sorted(message.SCALARS, key=lambda spec: spec.added):
        value: Any = getattr(message, spec.name)
        if spec.added:
            if value is None:
                continue
            data += spec.name.encode()
        if value is None:
            data += b"n"
        elif spec.kind == "bool":
            data += b"T" if value else b"F"
        elif spec.kind in ("int", "float"):
            data += struct.pack("<cq" if spec.kind == "int" else "<cd", spec.kind[0].encode(), value)
        elif spec.kind == "str":
            data += b"s" + struct.pack("<I", len(value.encode())) + value.encode()
        else:
            data += b"l" + struct.pack("<I", len(value))
            data += b"".join(struct.pack("<I", len(word.encode())) + word.encode() for word in value)
    for array_spec, held in zip(message.ARRAYS, message.arrays(), strict=True):
        if array_spec.added:
            if held is None:
                continue
            data += array_spec.name.encode()
        if held is None:
            data += b"\x00"
        else:
            data += b"\x01" + held.dtype.str.encode() + struct.pack(f"<B{held.ndim}q", held.ndim, *held.shape)
            data += held.tobytes()
    return xxhash.xxh3_128(data).digest()


def outcome(make: Callable[..., Message], values: Mapping[str, Any]) -> str | bytes:
    """The digest of what is made; the error where there is one."""
    try:
        message = make(**values)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    assert all(held is None or not held.flags.writeable for held in message.arrays())
    try:
        return documented_digest(message)
    except MessageError as error:  # of a message without stamp or frame
        return f"read: {error}"


def made_generally(cls: type[Message], /, **values: Any) -> Message:
    message = cls.__new__(cls)
    Message.__init__(message, **values)
    return message


def test_the_digest_is_the_documented_one() -> None:
    for message in (example(cls, seed) for cls in TYPES for seed in range(8)):
        assert message.digest() == documented_digest(message), message


class Large(Message, schema="tests.Large"):
    """Arrays on either side of the size from which one is digested in place."""

    name: str = scalar("str", "a name", default="x")
    first: npt.NDArray[np.uint8] = array("uint8", "N", "bytes")
    second: npt.NDArray[np.uint8] | None = array("uint8", "M", "bytes", default=None)
    third: npt.NDArray[np.float64] = array("float64", "N K", "numbers")


@pytest.mark.parametrize("first", [0, 1, ONE_UPDATE, ONE_UPDATE + 1])
@pytest.mark.parametrize("second", [None, 5, ONE_UPDATE + 1])
def test_the_digest_of_large_arrays_is_the_documented_one(first: int, second: int | None) -> None:
    message = Large(
        stamp=1,
        first=np.arange(first).astype(np.uint8),
        second=None if second is None else np.ones(second, np.uint8),
        third=np.zeros((first, 1)),
    )
    assert message.digest() == documented_digest(message)


def test_compiled_constructor_agrees_with_the_general_one() -> None:
    for cls, seed in itertools.product(TYPES, (0, 2)):
        values = dict(example(cls, seed).items())
        for name in values:
            for changed in (values | {name: odd} for odd in ODD):
                assert outcome(cls, changed) == outcome(functools.partial(made_generally, cls), changed), (cls, name)
            left = {n: v for n, v in values.items() if n != name}
            if name != "stamp":
                assert outcome(cls, left) == outcome(functools.partial(made_generally, cls), left), (cls, name)


class Pair(Message, schema="tests.Pair"):
    """Symbols that recur in one array, and between arrays of which the first may be missing."""

    square: npt.NDArray[np.float64] | None = array("float64", "N N", "a matrix", default=None)
    rows: npt.NDArray[np.float64] | None = array("float64", "N 2", "rows", default=None)
    either: npt.NDArray[np.float32 | np.float64] = array("float32|float64", "N 2|N 3", "rows of either form")


def test_equal_symbols_mean_equal_extents() -> None:
    Pair(stamp=0, either=np.zeros((1, 2)))
    forms = {
        "square": (None, (2, 2), (2, 3), (3, 3)),
        "rows": (None, (2, 2), (3, 2), (2, 3)),
        "either": ((2, 2), (2, 3), (3, 3), (2,), (2, 4)),
    }
    for shapes in itertools.product(*forms.values()):
        arrays = {name: None if shape is None else np.zeros(shape) for name, shape in zip(forms, shapes, strict=True)}
        expected = outcome(functools.partial(made_generally, Pair), {"stamp": 1, **arrays})
        assert outcome(Pair, {"stamp": 1, **arrays}) == expected, shapes


def test_message_copies_its_arrays() -> None:
    given_array = np.ones((2, 1))
    message = Large(stamp=1, first=np.zeros(2, np.uint8), third=given_array)
    given_array[:] = 5
    assert message.third.tolist() == [[1.0], [1.0]]


def test_a_type_below_another_has_its_own_constructor() -> None:
    class Below(Large, schema="tests.Below"):
        """One field more."""

        more: int = scalar("int", "one more", default=1)

    Large(stamp=1, first=[1], third=[[1.0]])
    below = Below(stamp=1, first=[1], third=[[1.0]], more=4)
    assert (below.more, below.digest()) == (4, documented_digest(below))
    with pytest.raises(MessageError, match=r"tests\.Large has no field 'more'"):
        Large(stamp=1, first=[1], third=[[1.0]], more=4)


def test_a_handwritten_constructor_stays() -> None:
    class Written(Message, schema="tests.Written"):
        """Takes its value by position."""

        value: int = scalar("int", "a value")

        def __init__(self, value: int) -> None:
            super().__init__(stamp=1, value=value)

    class BelowWritten(Written, schema="tests.BelowWritten"):
        """Inherits that."""

    for cls in (Written, Written, BelowWritten, BelowWritten):
        assert (cls(5).value, cls(5).stamp) == (5, 1)


def test_names_that_are_no_plain_identifiers_are_fields_all_the_same() -> None:
    made = type("Odd", (Message,), {"größe": scalar("int", "ligature"), "class": scalar("int", "keyword")})
    message = made(stamp=1, **{"größe": 1, "class": 2})
    message = made(stamp=1, **{"größe": 1, "class": 2})
    assert [value for _, value in message.items()] == [1, 1, 2]
    assert message.digest() == documented_digest(message)
