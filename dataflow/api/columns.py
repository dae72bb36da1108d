"""Fields of many messages as numpy arrays, and the names of their components. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import ArrayField, Field, Message

Column = npt.NDArray[Any]

_AXES = {3: "xyz", 4: "xyzw"}
"""Letters of the components of a vector and of a quaternion."""
_SCALARS = {"bool": np.bool_, "int": np.int64, "float": np.float64}


def column(field: Field, values: Sequence[Any] | Column) -> Column:
    """One field of N messages; `values` holds None where a message has none, or is the column already.

    Arrays that have one shape in all messages are stacked to (N, ...); those of different shapes stay apart, in an
    array of objects. Where some are None, floating-point fields hold NaN; others make an array of objects.
    """
    if isinstance(values, np.ndarray):
        return values
    if isinstance(field, ArrayField):
        return _stacked(field, values)
    if field.kind in ("str", "strs") or any(value is None for value in values):
        if field.kind == "float":
            return np.array([np.nan if value is None else value for value in values], np.float64)
        return _objects(values)
    return np.array(values, _SCALARS[field.kind])


def _stacked(field: ArrayField, values: Sequence[Any]) -> Column:
    present = [value for value in values if value is not None]
    shapes, dtypes = {value.shape for value in present}, {value.dtype for value in present}
    if not present:
        fixed = fixed_shape(field)
        if field.dtypes[0].kind == "f" and fixed is not None:
            return np.full((len(values), *fixed), np.nan, field.dtypes[0])
        return _objects(values)
    if len(shapes) > 1 or len(dtypes) > 1:
        return _objects(values)
    if len(present) == len(values):
        return np.stack(present)
    if present[0].dtype.kind != "f":
        return _objects(values)
    absent = np.full(present[0].shape, np.nan, present[0].dtype)
    return np.stack([absent if value is None else value for value in values])


def _objects(values: Sequence[Any]) -> Column:
    made = np.empty(len(values), object)
    made[:] = values if all(not isinstance(value, (np.ndarray, tuple)) for value in values) else None
    if len(values) and made[0] is None:
        for i, value in enumerate(values):
            made[i] = value
    return made


def fixed_shape(field: Field) -> tuple[int, ...] | None:
    """The one shape that an array field always has; None where it varies, and for scalars."""
    if not isinstance(field, ArrayField) or len(field.shapes) != 1:
        return None
    extents = tuple(extent for extent in field.shapes[0] if isinstance(extent, int))
    return extents if len(extents) == len(field.shapes[0]) else None


def is_narrow(field: Field) -> bool:
    """Returns whether the field fits a table unasked: a scalar or a vector of fixed length."""
    if isinstance(field, ArrayField):
        shape = fixed_shape(field)
        return shape is not None and len(shape) == 1
    return field.kind != "strs"


def expanded(name: str, data: Column) -> Iterator[tuple[str, Column]]:
    """(name, (N,) column) of each component of a column (N, ...): `position.x`, `covariance.0.1`."""
    if data.ndim <= 1:
        yield name, data
        return
    for place in np.ndindex(data.shape[1:]):
        letters = _AXES.get(data.shape[1]) if data.ndim == 2 else None
        parts = [letters[place[0]]] if letters else [str(k) for k in place]
        yield ".".join((name, *parts)), data[(slice(None), *place)]


@dataclass(frozen=True, slots=True)
class Elements:
    """The elements of parallel arrays, those of all messages one after the other.

    `message`: (M,) place of the message of each element; `number`: (M,) its place in that message; `columns`: by field,
    (M, ...).
    """

    message: npt.NDArray[np.int64]
    number: npt.NDArray[np.int64]
    columns: Mapping[str, Column]


def parallel_fields(message: type[Message]) -> tuple[Field, ...]:
    """The fields of a message type that run in parallel: those that share the first symbol of most arrays.

    Lists of strings may belong to them, as their lengths show. Empty where there are no such arrays.
    """
    counts: dict[str, int] = {}
    for field in message.ARRAYS:
        symbol = _symbol(field)
        if symbol is not None:
            counts[symbol] = counts.get(symbol, 0) + 1
    if not counts:
        return ()
    chosen = max(counts, key=lambda symbol: counts[symbol])
    return tuple(f for f in message.FIELDS if (isinstance(f, ArrayField) and _symbol(f) == chosen) or _is_strings(f))


def _symbol(field: ArrayField) -> str | None:
    """The symbol of the first extent, where further extents are fixed in every accepted shape."""
    firsts = {shape[0] for shape in field.shapes if shape}
    rest = [extent for shape in field.shapes for extent in shape[1:]]
    (first,) = firsts if len(firsts) == 1 else (None,)
    return first if isinstance(first, str) and all(isinstance(extent, int) for extent in rest) else None


def _is_strings(field: Field) -> bool:
    return not isinstance(field, ArrayField) and field.kind == "strs"


def elements(fields: Sequence[Field], values: Mapping[str, Sequence[Any] | Column]) -> Elements:
    """The elements of the parallel `fields` of messages; `values` by field as for `column`.

    A field that is None in a message which has elements is NaN there (floating point), else None; one that is None in
    all is left out, and so is a list of strings that does not have a string for each element.
    """
    arrays = [f for f in fields if isinstance(f, ArrayField)]
    by_message = list(zip(*(values[f.name] for f in arrays), strict=True))
    counts = np.array([next((len(v) for v in row if v is not None), 0) for row in by_message], np.int64)
    columns: dict[str, Column] = {}
    for field in fields:
        given = zip(values[field.name], counts.tolist(), strict=True)
        parts = [(value, count) for value, count in given if count]
        if all(value is None for value, _ in parts):
            continue
        if not isinstance(field, ArrayField):
            if all(value is not None and len(value) == count for value, count in parts):
                columns[field.name] = _objects([word for value, _ in parts for word in value or ()])
            continue
        columns[field.name] = _joined(parts)
    starts = np.cumsum(counts) - counts
    return Elements(
        np.repeat(np.arange(len(counts), dtype=np.int64), counts),
        np.arange(int(counts.sum()), dtype=np.int64) - np.repeat(starts, counts),
        columns,
    )


def _joined(parts: Sequence[tuple[Column | None, int]]) -> Column:
    present = [value for value, _ in parts if value is not None]
    if len({value.shape[1:] for value in present}) > 1:
        return _objects([element for value, count in parts for element in ([None] * count if value is None else value)])
    filler: Any = np.nan if present[0].dtype.kind == "f" else None
    dtype = present[0].dtype if filler is not None or len(present) == len(parts) else np.dtype(object)
    return np.concatenate(
        [np.full((count, *present[0].shape[1:]), filler, dtype) if value is None else value for value, count in parts]
    )
