"""The fields that a message declares: what each accepts, and its canonical form."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from dataflow.messages.fields.memory import copied

ScalarKind = Literal["bool", "int", "float", "str", "strs"]
Scalar = bool | int | float | str | tuple[str, ...]

MISSING: Any = object()
ANCHOR: Any = object()
"""Default of a field `frame` that is the sensor's or the data's: the frame of the anchor, as `Message` describes."""
INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1
_PYTHON_NAME = {"bool": "bool", "int": "int", "float": "float", "str": "str", "strs": "sequence of str"}
TAKEN = ("stamp", "timestamp")
"""No names for fields: every message has the first, and recordings write it as the second."""
SYMBOL = re.compile(r"[A-Z][A-Za-z]*")


class MessageError(ValueError):
    """A message that cannot be: names the type, the field, what was given and what would be right."""


@dataclass(frozen=True, slots=True)
class ScalarField:
    """A header field: one Python scalar, or a tuple of strings (`strs`)."""

    name: str
    kind: ScalarKind
    doc: str
    optional: bool
    default: Any
    choices: tuple[str, ...]
    added: bool = False
    """The type got it after recordings of it were made: None counts in no digest, so theirs stay."""
    anchored: bool = False
    """A message may be constructed without it; the runner fills it in."""

    @property
    def required(self) -> bool:
        return self.default is MISSING and not self.optional


def little_endian(dtype: str) -> np.dtype[Any]:
    """The dtype of that name, little-endian: numpy's single object for it, so that `is` compares it."""
    return np.dtype(np.dtype(dtype).newbyteorder("<").str)


@dataclass(frozen=True, slots=True)
class ArrayField:
    """An array field.

    `shapes` holds the accepted shapes, each a tuple of fixed extents (int) and symbols (str); equal symbols within one
    message mean equal extents (`"N 3"` and `"N"` are parallel). `dtypes[0]` is the canonical one that lists are
    converted to.
    """

    name: str
    dtypes: tuple[np.dtype[Any], ...]
    shapes: tuple[tuple[int | str, ...], ...]
    doc: str
    unit: str
    optional: bool
    added: bool = False
    """As of a scalar."""

    @property
    def required(self) -> bool:
        return not self.optional

    def shape_text(self) -> str:
        return " or ".join("(" + ", ".join(map(str, s)) + ("," if len(s) == 1 else "") + ")" for s in self.shapes)

    def dtype_text(self) -> str:
        return " or ".join(d.name for d in self.dtypes)


Field = ScalarField | ArrayField


def scalar(
    kind: ScalarKind,
    doc: str,
    *,
    default: Any = MISSING,
    optional: bool = False,
    choices: Sequence[str] = (),
    added: bool = False,
) -> Any:
    """Declares a header field of a message. `default=None` makes it optional: it may be None.

    `default=ANCHOR`: the frame of the anchor, where a message is made in `process()`. `added`: a built-in type got the
    field after recordings of it were made; its default is None. Raises `MessageError`.
    """
    anchored = default is ANCHOR
    if anchored:
        default = MISSING
        if kind != "str":
            raise MessageError(f"default=ANCHOR is the name of a frame: the kind is str, got {kind}")
    optional = optional or default is None
    if default is not MISSING and default is not None:
        given, default = default, canonical_scalar(kind, default)
        if default is None or (choices and default not in choices):
            raise MessageError(f"default {given!r} is not a {_PYTHON_NAME[kind]}{f' of {choices}' if choices else ''}")
    return ScalarField("", kind, doc, optional, default, tuple(choices), added, anchored)


def array(
    dtype: str,
    shape: str,
    doc: str,
    *,
    unit: str = "",
    default: None = MISSING,
    optional: bool = False,
    added: bool = False,
) -> Any:
    """Declares an array field. `dtype` and `shape` list alternatives with `|`: `array("uint8", "H W 3|H W", ...)`.

    `default=None` makes it optional: it may be None. `added`: as of `scalar`.

    Symbols begin with a capital letter; `N` in two fields of one message means the same extent.
    """
    shapes = tuple(
        tuple(int(word) if word.isdigit() else word for word in alternative.split()) for alternative in shape.split("|")
    )
    for extent in (e for s in shapes for e in s if isinstance(e, str)):
        if not SYMBOL.fullmatch(extent):
            raise MessageError(f"array shape {shape!r}: {extent!r} is neither a number nor a capitalised symbol")
    dtypes = tuple(little_endian(d.strip()) for d in dtype.split("|"))
    return ArrayField("", dtypes, shapes, doc, unit, optional or default is None, added)


def canonical_stamp(schema: str, stamp: Any) -> int:
    """Returns a stamp as an int. Raises `MessageError` for what is none."""
    if isinstance(stamp, (bool, float, str)) or not hasattr(stamp, "__index__"):
        raise MessageError(f"{schema}.stamp must be an integer (nanoseconds since the epoch), got {stamp!r}")
    value = int(stamp)
    if not INT64_MIN < value < INT64_MAX:
        raise MessageError(f"{schema}.stamp {value} is outside the 64-bit range of nanoseconds")
    return value


def scalar_value(schema: str, spec: ScalarField, value: Any) -> Scalar | None:
    if value is MISSING:
        if spec.required:
            raise MessageError(f"{schema}.{spec.name} is required ({_PYTHON_NAME[spec.kind]}: {spec.doc})")
        return None if spec.default is MISSING else spec.default
    if value is None:
        if spec.optional:
            return None
        raise MessageError(f"{schema}.{spec.name} must be a {_PYTHON_NAME[spec.kind]}, got None")
    converted = canonical_scalar(spec.kind, value)
    if converted is None:
        raise MessageError(
            f"{schema}.{spec.name} must be a {_PYTHON_NAME[spec.kind]} ({spec.doc}), got {value!r} "
            f"({type(value).__name__})"
        )
    if spec.choices and converted not in spec.choices:
        raise MessageError(f"{schema}.{spec.name} must be one of {', '.join(spec.choices)}, got {value!r}")
    return converted


def canonical_scalar(kind: ScalarKind, value: Any) -> Scalar | None:
    """`value` as the declared Python type, or None when it is of another kind."""
    match kind:
        case "bool":
            return bool(value) if isinstance(value, (bool, np.bool_)) else None
        case "int":
            if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
                whole = int(value)
                return whole if INT64_MIN <= whole <= INT64_MAX else None
            return None
        case "float":
            if isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool):
                return float(value)
            return None
        case "str":
            return str(value) if isinstance(value, str) and _is_utf8(value) else None
        case "strs":
            if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
                return None
            words = tuple([str(v) for v in value if isinstance(v, str)])
            return words if len(words) == len(value) and _is_utf8("".join(words)) else None


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def array_value(
    schema: str, spec: ArrayField, value: Any, extents: dict[str, tuple[int, str]]
) -> npt.NDArray[Any] | None:
    if value is None:
        if spec.required:
            raise MessageError(
                f"{schema}.{spec.name} is required ({spec.dtype_text()} array of shape {spec.shape_text()}: {spec.doc})"
            )
        return None
    data = value if isinstance(value, np.ndarray) else _from_sequence(schema, spec, value)
    dtype = next((d for d in spec.dtypes if d == data.dtype), None)
    if dtype is None:
        dtype = next((d for d in spec.dtypes if np.can_cast(data.dtype, d, "same_kind")), None)
    if dtype is None:
        raise MessageError(f"{schema}.{spec.name} must be {spec.dtype_text()}, got an array of {data.dtype}")
    same = data.dtype == dtype
    frozen: npt.NDArray[Any] = copied(np.asarray(data)) if same else np.array(data, dtype=dtype, order="C", copy=True)
    if dtype.kind in "iu" and not same and not np.array_equal(frozen, data):
        raise MessageError(
            f"{schema}.{spec.name} must be {spec.dtype_text()}, got {data.dtype} with values that do not fit: "
            f"{data.min()} to {data.max()}"
        )
    frozen.flags.writeable = False
    check_shape(schema, spec, frozen, extents)
    return frozen


def _from_sequence(schema: str, spec: ArrayField, value: Any) -> npt.NDArray[Any]:
    try:
        data = np.asarray(value)
        if data.size == 0 or spec.dtypes[0].kind in "fb" or data.dtype.kind in "iub":
            data = np.asarray(value, dtype=spec.dtypes[0])
    except (TypeError, ValueError, OverflowError) as error:
        raise MessageError(
            f"{schema}.{spec.name} must be a {spec.dtype_text()} array of shape {spec.shape_text()}: {error}"
        ) from None
    if data.size == 0 and data.ndim == 1:  # [] for "N 3" means (0, 3)
        columns = next((s[1] for s in spec.shapes if len(s) == 2 and isinstance(s[1], int)), None)
        data = data if columns is None else data.reshape(0, columns)
    return data


def check_shape(
    schema: str, spec: ArrayField, data: npt.NDArray[Any] | None, extents: dict[str, tuple[int, str]]
) -> None:
    if data is None:
        if spec.required:
            raise MessageError(f"{schema}.{spec.name} is required")
        return
    for shape in spec.shapes:
        if len(shape) == data.ndim and all(
            want == have for want, have in zip(shape, data.shape, strict=True) if isinstance(want, int)
        ):
            break
    else:
        raise MessageError(f"{schema}.{spec.name} must have shape {spec.shape_text()}, got {data.shape}")
    for want, have in zip(shape, data.shape, strict=True):
        if isinstance(want, str):
            known, owner = extents.setdefault(want, (have, spec.name))
            if known != have:
                raise MessageError(
                    f"{schema}.{spec.name} has {want}={have}, but {owner} has {want}={known}: they must be parallel"
                )
