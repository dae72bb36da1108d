"""Checks that several message families share: ranges, order, tables, quaternions, parallel lists.

Each takes the message and the name of the field, does nothing when an optional field is None, and raises `MessageError`
with what was given, at which index, and what would be right.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import Message, MessageError

QUATERNION_TOLERANCE = 1e-3


def field(message: Message, name: str) -> Any:
    """The value of a field by name."""
    return message.__dict__[name]


def unit_quaternions(message: Message, *names: str) -> None:
    """Quaternions (..., 4) have norm 1 within 1e-3. They are not renormalised: what was given is what is kept."""
    for name in names:
        data = field(message, name)
        if data is not None and data.size:
            unit_vectors(message, name, data, "must be a unit quaternion (x, y, z, w)")


def unit_vectors(message: Message, name: str, data: npt.NDArray[Any], right: str = "must have unit length") -> None:
    """Rows of `data` (..., N) have norm 1 within 1e-3; `name` is the field they come from."""
    norms = np.sqrt((data * data).sum(axis=-1))
    _refuse(message, name, data, ~(np.abs(norms - 1.0) <= QUATERNION_TOLERANCE), right)


def within(message: Message, low: float, high: float, *names: str, nan: bool = False) -> None:
    """Values lie in [low, high]; NaN only with `nan`. Scalars and arrays."""
    for name in names:
        data = field(message, name)
        if data is None:
            continue
        data = np.asarray(data)
        if not data.size or (data.min() >= low and data.max() <= high):
            continue
        inside = (data >= low) & (data <= high)
        if nan:
            inside |= np.isnan(data)
        _refuse(message, name, data, ~inside, f"must lie in [{low:g}, {high:g}]" + (" or be NaN" if nan else ""))


def finite(message: Message, *names: str) -> None:
    """Values are neither NaN nor infinite. Scalars and arrays."""
    for name in names:
        data = field(message, name)
        if data is not None:
            data = np.asarray(data)
            _refuse(message, name, data, ~np.isfinite(data), "must be finite")


def positive(message: Message, *names: str) -> None:
    """Scalars are finite and above zero."""
    for name in names:
        value = field(message, name)
        if value is not None and not 0 < value < float("inf"):
            raise MessageError(f"{message.SCHEMA}.{name} must be above zero, got {value!r}")


def not_empty(message: Message, name: str) -> None:
    """No extent of an array is 0."""
    shape = field(message, name).shape
    if 0 in shape:
        raise MessageError(f"{message.SCHEMA}.{name} must hold at least one element, got shape {shape}")


def ordered_boxes(message: Message, name: str, *, nan: bool = False) -> None:
    """Boxes (N, 4) are (x1, y1, x2, y2) with x1 ≤ x2 and y1 ≤ y2; with `nan`, a row of NaN stands for no box."""
    data = field(message, name)
    if data is not None and len(data):
        wrong = ~((data[:, 0] <= data[:, 2]) & (data[:, 1] <= data[:, 3]))
        if nan:
            wrong &= ~np.isnan(data).all(axis=1)
        _refuse(message, name, data, wrong, "must be (x1, y1, x2, y2) with x1 ≤ x2 and y1 ≤ y2")


def table_indices(message: Message, name: str, table: str) -> None:
    """Integers are ≥ 0 and index the table of strings `table`; an empty table leaves them without names."""
    data = field(message, name)
    words = field(message, table)
    if data is None or not data.size:
        return
    if words:
        within_length(message, name, len(words), f"index {table}, which has {len(words)} entries")
    else:
        _refuse(message, name, data, data < 0, "must be ≥ 0")


def within_length(message: Message, name: str, length: int, meaning: str, *, none: int | None = None) -> None:
    """Integers lie in [0, length), or equal `none` where that stands for nothing."""
    data = field(message, name)
    if data is None or not data.size:
        return
    lowest = 0 if none is None else none
    if data.min() < lowest or data.max() >= length:
        _refuse(message, name, data, (data < lowest) | (data >= length), f"must {meaning}")


def parallel(message: Message, name: str, count: int, to: str, *, empty: bool = False) -> None:
    """A list of strings has `count` entries, as the field `to`; with `empty`, no entry at all is right as well."""
    words = field(message, name)
    if len(words) != count and not (empty and not words):
        raise MessageError(
            f"{message.SCHEMA}.{name} has {len(words)} entries, but {to} has {count}: they must be parallel"
            + (f", or {name} empty" if empty else "")
        )


def unique(message: Message, name: str) -> None:
    """No integer, or no string, occurs twice."""
    values = field(message, name)
    values = values if isinstance(values, tuple) else values.tolist()
    if len(set(values)) < len(values):
        twice = next(value for value in sorted(values) if values.count(value) > 1)
        raise MessageError(f"{message.SCHEMA}.{name} must be unique, {twice!r} occurs more than once")


def class_columns(message: Message, name: str) -> None:
    """An array (N, C) has a column for each of `class_names`, where there are any."""
    data, names = field(message, name), field(message, "class_names")
    if data is not None and names and data.shape[1] != len(names):
        raise MessageError(
            f"{message.SCHEMA}.{name} must have one column for each of the {len(names)} class_names, "
            f"got shape {data.shape}"
        )


def together(message: Message, *names: str) -> None:
    """The named optional fields are all given or all None."""
    given = [n for n in names if field(message, n) is not None]
    if given and len(given) != len(names):
        missing = ", ".join(n for n in names if n not in given)
        raise MessageError(f"{message.SCHEMA}.{given[0]} is given without {missing}: they come together")


def _refuse(message: Message, name: str, data: npt.NDArray[Any], wrong: npt.NDArray[Any], right: str) -> None:
    if not wrong.any():
        return
    index = tuple(int(i) for i in np.argwhere(wrong)[0])
    where = f"[{', '.join(map(str, index))}]" if index else ""
    value = data[index].tolist()
    count = int(np.count_nonzero(wrong))
    more = f" (and {count - 1} more)" if count > 1 else ""
    raise MessageError(f"{message.SCHEMA}.{name}{where} {right}, got {value!r}{more}")
