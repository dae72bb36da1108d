"""Columns of Arrow made of their bytes.

`pyarrow.array` asks whether its values are of pandas, and imports it for that: 0.25 s of CPU time where it is there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa


def table(rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> pa.Table:
    """Returns a table of rows by a schema of text, int64, float64, and maps of text to float64, these as pairs.

    What a row lacks is null.
    """
    columns = [_column([row.get(field.name) for row in rows], field.type) for field in schema]
    return pa.Table.from_arrays(columns, schema=schema)


def _column(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    here = np.array([value is not None for value in values], bool)
    known = None if here.all() else pa.py_buffer(np.packbits(here, bitorder="little").tobytes())
    if pa.types.is_map(kind):
        return _maps([value or () for value in values], kind)
    if pa.types.is_string(kind):
        return _texts(["" if value is None else value for value in values], known)
    numbers = np.array([0 if value is None else value for value in values], kind.to_pandas_dtype())
    return pa.Array.from_buffers(kind, len(values), [known, pa.py_buffer(numbers.tobytes())])


def _texts(values: Sequence[str], known: pa.Buffer | None) -> pa.Array:
    encoded = [value.encode() for value in values]
    offsets = _offsets([len(each) for each in encoded])
    return pa.Array.from_buffers(
        pa.string(), len(values), [known, pa.py_buffer(offsets.tobytes()), pa.py_buffer(b"".join(encoded))]
    )


def _maps(values: Sequence[Sequence[tuple[str, float]]], kind: pa.MapType) -> pa.Array:
    offsets = _offsets([len(each) for each in values])
    pairs = [pair for each in values for pair in each]
    places = pa.Array.from_buffers(pa.int32(), len(offsets), [None, pa.py_buffer(offsets.tobytes())])
    keys = _texts([name for name, _ in pairs], None)
    return pa.MapArray.from_arrays(places, keys, _column([number for _, number in pairs], kind.item_type))


def _offsets(lengths: Sequence[int]) -> np.ndarray[Any, np.dtype[np.int32]]:
    return np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int32)
