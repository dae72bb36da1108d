"""Fields of many JSON messages at once: what plain JSON holds becomes columns without a look at each message."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import ArrayField, Field, ScalarField
from dataflow.recording.streams.json_codec import EXACT, decode_fields, decode_object

Values = list[Any] | npt.NDArray[Any]
"""One field of many messages: their values, None where absent; or, where all are arrays of one shape, stacked."""

_ABSENT: Any = object()
_TYPES = {"int": int, "float": float, "bool": bool, "str": str}


def decode_json_columns(messages: Iterable[Any], fields: Iterable[Field]) -> dict[str, Values]:
    """The named fields of JSON messages, as `decode_fields` gives them of each. Raises `RecordingError`."""
    objects = [decode_object(data) for data in messages]
    return {field.name: _column(field, objects) for field in fields}


def _column(field: Field, objects: Sequence[Any]) -> Values:
    found = None
    if all(_is_plain(value, field.name) for value in objects):
        plain = [value.get(field.name, _ABSENT) for value in objects]
        found = _vectors(field, plain) if isinstance(field, ArrayField) else _scalars(field, plain)
    if found is not None:
        return found
    return [decode_fields(value, (field,)).get(field.name) for value in objects]


def _is_plain(value: Any, name: str) -> bool:
    """Returns whether the field of a message stands in plain JSON alone, or nowhere."""
    if type(value) is not dict:
        return False
    exact = value.get(EXACT)
    return exact is None or (type(exact) is dict and name not in exact)


def _scalars(field: ScalarField, plain: list[Any]) -> Values | None:
    """The values, if all are of the field's JSON type, or all are absent."""
    types = set(map(type, plain))
    if types <= {_TYPES.get(field.kind)}:
        return plain
    return [None] * len(plain) if all(value is _ABSENT for value in plain) else None


def _vectors(field: ArrayField, plain: list[Any]) -> Values | None:
    """The stacked arrays, if all are lists of one length, or None for all that are absent."""
    if all(value is _ABSENT for value in plain):
        return [None] * len(plain)
    if set(map(type, plain)) != {list} or len({len(value) for value in plain}) > 1:
        return None
    try:
        stacked = np.array(plain, field.dtypes[0])
    except (ValueError, TypeError, OverflowError):  # the way through single messages names the one, and why
        return None
    stacked.flags.writeable = False
    return stacked if stacked.ndim == 2 else None
