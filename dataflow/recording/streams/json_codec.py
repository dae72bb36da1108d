"""Messages as JSON objects with a JSON Schema made from the message's declaration; lossless.

    {"timestamp": {"sec": 12, "nsec": 5}, "frame": "base", "score": 0.5, "boxes": [0.0, 1.0, 2.0, 3.0],
     "_exact": {"boxes": {"dtype": "float32", "shape": [1, 4]}}}

Every property has one JSON type, so that plotting tools, which know no unions, take the schema. Values that plain JSON
cannot hold stand under `_exact`: integers beyond ±2^53 and floats that are not finite as strings, arrays that are
long (over 64 elements) or hold such values as {dtype, shape, base64}, and the dtype and shape of arrays whose flat list
does not give them. A field that stands nowhere is None.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from dataflow.messages.base import ArrayField, Field, Message, ScalarField
from dataflow.recording.errors import RecordingError

EXACT = "_exact"
TIMESTAMP = "timestamp"
NONE = "_none"
MAX_LISTED = 64
MAX_SAFE_INTEGER = 2**53

LONG_BYTES = 4096
"""Arrays of this size go into the text as base64 when the rest of it is made: the encoder looks at every character."""

_CANONICAL_NAN = struct.pack("<d", math.nan)
_FLOAT_WORDS = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_FLOAT_PATTERN = "^(NaN|-?Infinity|0x[0-9a-f]{16})$"


def encode_fields(message: Message, fields: Iterable[Field]) -> dict[str, Any]:
    """The JSON object of some fields of `message`, without its timestamp."""
    plain: dict[str, Any] = {}
    exact: dict[str, Any] = {}
    for spec in fields:
        value = getattr(message, spec.name)
        if value is None:
            continue
        if isinstance(spec, ArrayField):
            _encode_array(spec, value, plain, exact)
        elif isinstance(value, int) and not isinstance(value, bool) and abs(value) > MAX_SAFE_INTEGER:
            exact[spec.name] = str(value)
        elif isinstance(value, float) and not math.isfinite(value):
            exact[spec.name] = _float_text(value)
        else:
            plain[spec.name] = list(value) if isinstance(value, tuple) else value
    if exact:
        plain[EXACT] = exact
    return plain


def decode_fields(value: Any, fields: Iterable[Field]) -> dict[str, Any]:
    """The fields found in a JSON object made by `encode_fields`: canonical scalars and frozen arrays.

    Raises `RecordingError` for values that `encode_fields` does not write.
    """
    if not isinstance(value, dict):
        raise RecordingError(f"expected a JSON object, got {type(value).__name__}")
    exact = value.get(EXACT, {})
    if not isinstance(exact, dict):
        raise RecordingError(f"{EXACT} must be a JSON object, got {type(exact).__name__}")
    found: dict[str, Any] = {}
    for spec in fields:
        name = spec.name
        if name not in value and name not in exact:
            continue
        try:
            if isinstance(spec, ArrayField):
                found[name] = _decode_array(spec, value.get(name), exact.get(name))
            else:
                found[name] = _decode_scalar(spec, value.get(name), exact.get(name))
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
            raise RecordingError(f"field {name!r}: {type(error).__name__}: {error}") from error
    return found


_PLACE = "\0"
_PLACED = b'"base64":"\\u0000"'
"""The text in the place of a long array. Before the last ones, a field that is named base64 may read so too."""


def encode_object(value: Mapping[str, Any]) -> bytes:
    """The text of a JSON object, such as `encode_fields` makes: long arrays are memory in it."""
    long: list[memoryview] = []

    def place(thing: Any) -> str:
        if not isinstance(thing, memoryview):
            raise TypeError(f"a {type(thing).__name__} is no JSON value")
        long.append(thing)
        return _PLACE

    text = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":"), default=place).encode(value)
    if not long:
        return text.encode()
    before, *others = text.encode().rsplit(_PLACED, len(long))
    parts = [before]
    for data, after in zip(long, others, strict=True):
        parts += (b'"base64":"', binascii.b2a_base64(data, newline=False), b'"', after)
    return b"".join(parts)


def decode_object(data: Any) -> Any:
    try:
        return json.loads(str(data, "utf-8"))  # strings cost no second look at their encoding
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"not JSON: {error}") from error


def timestamp_object(stamp: int) -> dict[str, int]:
    """`stamp` (ns) as tools expect it: {"sec", "nsec"}."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


def json_schema(message: type[Message], fields: Iterable[Field], *, companion_of: str = "") -> bytes:
    """The JSON Schema of objects with `fields` of a message type; with `companion_of`, of its companion objects."""
    specs = tuple(fields)
    plain: dict[str, Any] = {
        TIMESTAMP: {
            "type": "object",
            "title": "time",
            "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            "required": ["sec", "nsec"],
            "description": "event time since the Unix epoch",
        }
    }
    exact: dict[str, Any] = {}
    for spec in specs:
        plain[spec.name], precise = _schemas(spec)
        if precise is not None:
            exact[spec.name] = precise
    if exact:
        plain[EXACT] = {
            "type": "object",
            "properties": exact,
            "additionalProperties": False,
            "description": "what plain JSON cannot hold, by field",
        }
    if companion_of:
        plain[NONE] = {
            "type": "array",
            "items": {"type": "string"},
            "description": f"fields that are None although {companion_of} holds a value for them",
        }
    document = (message.__doc__ or "").strip().split("\n\n")[0]
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": message.SCHEMA,
        "description": f"What {companion_of} lacks of: {document}" if companion_of else document,
        "type": "object",
        "properties": plain,
        "required": [TIMESTAMP],
        "additionalProperties": False,
    }
    return json.dumps(schema, ensure_ascii=False, indent=1).encode()


def _schemas(spec: Field) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The schema of a field's plain form, and of its exact form where it has one."""
    if isinstance(spec, ArrayField):
        kind = {"b": "boolean", "f": "number"}.get(spec.dtypes[0].kind, "integer")
        unit = f" [{spec.unit}]" if spec.unit else ""
        described = f"{spec.doc}{unit}; {spec.dtype_text()} {spec.shape_text()}, row-major"
        packed = {
            "type": "object",
            "properties": {
                "dtype": {"type": "string", "enum": [d.name for d in spec.dtypes]},
                "shape": {"type": "array", "items": {"type": "integer", "minimum": 0}},
                "base64": {"type": "string", "contentEncoding": "base64"},
            },
            "required": ["dtype", "shape"],
            "additionalProperties": False,
        }
        plain = {"type": "array", "items": {"type": kind}, "maxItems": MAX_LISTED, "description": described}
        return plain, packed
    match spec.kind:
        case "int":
            return {"type": "integer", "description": spec.doc}, {"type": "string", "pattern": "^-?[0-9]+$"}
        case "float":
            return {"type": "number", "description": spec.doc}, {"type": "string", "pattern": _FLOAT_PATTERN}
        case "bool":
            return {"type": "boolean", "description": spec.doc}, None
        case "strs":
            return {"type": "array", "items": {"type": "string"}, "description": spec.doc}, None
        case "str":
            return {"type": "string", "description": spec.doc}, None


def _encode_array(spec: ArrayField, data: npt.NDArray[Any], plain: dict[str, Any], exact: dict[str, Any]) -> None:
    if data.size > MAX_LISTED or not _listable(data):
        exact[spec.name] = {"dtype": _dtype_name(data.dtype), "shape": list(data.shape), "base64": _base64(data)}
        return
    plain[spec.name] = data.ravel().tolist()
    if data.ndim != 1 or data.dtype != spec.dtypes[0]:
        exact[spec.name] = {"dtype": _dtype_name(data.dtype), "shape": list(data.shape)}


def _base64(data: npt.NDArray[Any]) -> str | memoryview:
    if not data.size:
        return ""
    return base64.b64encode(data.data).decode() if data.nbytes < LONG_BYTES else data.data


def _listable(data: npt.NDArray[Any]) -> bool:
    """Returns whether JSON numbers hold every element."""
    if data.dtype.kind == "f":
        return bool(np.isfinite(data).all())
    if data.dtype.itemsize == 8 and data.size:
        return int(data.min()) >= -MAX_SAFE_INTEGER and int(data.max()) <= MAX_SAFE_INTEGER
    return True


def _decode_array(spec: ArrayField, plain: Any, exact: Any) -> npt.NDArray[Any]:
    dtype = spec.dtypes[0] if exact is None else _dtype(spec, exact["dtype"])
    if exact is not None and "base64" in exact:
        data = np.frombuffer(binascii.a2b_base64(exact["base64"], strict_mode=True), dtype)
    else:
        data = np.array(plain, dtype)
    if exact is not None:
        data = data.reshape([int(extent) for extent in exact["shape"]])
    data.flags.writeable = False
    return data


def _dtype(spec: ArrayField, name: Any) -> np.dtype[Any]:
    for dtype in spec.dtypes:
        if _dtype_name(dtype) == name:
            return dtype
    raise ValueError(f"dtype {name!r}; the declaration has {spec.dtype_text()}")


@cache
def _dtype_name(dtype: np.dtype[Any]) -> str:
    """Its name, which numpy makes anew each time."""
    return dtype.name


def _decode_scalar(spec: ScalarField, plain: Any, exact: Any) -> Any:
    if exact is None:
        return float(plain) if spec.kind == "float" else plain
    if spec.kind == "int":
        return int(exact)
    if spec.kind == "float":
        if exact in _FLOAT_WORDS:
            return _FLOAT_WORDS[exact]
        return struct.unpack(">d", bytes.fromhex(exact.removeprefix("0x")))[0]
    raise ValueError(f"a {spec.kind} has no exact form, got {exact!r}")


def _float_text(value: float) -> str:
    if math.isnan(value):
        raw = struct.pack("<d", value)
        return "NaN" if raw == _CANONICAL_NAN else f"0x{raw[::-1].hex()}"
    return "Infinity" if value > 0 else "-Infinity"
