"""The base of every message: declared fields, canonical form, immutability and the digest.

A message class declares its fields once; construction validates them and brings them into canonical form
(C-contiguous little-endian arrays of the declared dtype, scalars of the declared Python type), so that equal values
have equal digests wherever and however they were made.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self, dataclass_transform

import numpy as np
import numpy.typing as npt
import xxhash

ScalarKind = Literal["bool", "int", "float", "str", "strs"]
Scalar = bool | int | float | str | tuple[str, ...]

_MISSING: Any = object()
_INT64_MIN, _INT64_MAX = -(2**63), 2**63 - 1
_PYTHON_NAME = {"bool": "bool", "int": "int", "float": "float", "str": "str", "strs": "sequence of str"}
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

    @property
    def required(self) -> bool:
        return self.default is _MISSING and not self.optional


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
    default: Any = _MISSING,
    optional: bool = False,
    choices: Sequence[str] = (),
) -> Any:
    """Declares a header field of a message. `default=None` makes it optional: it may be None."""
    optional = optional or default is None
    if default is not _MISSING and default is not None:
        given, default = default, _canonical_scalar(kind, default)
        if default is None or (choices and default not in choices):
            raise MessageError(f"default {given!r} is not a {_PYTHON_NAME[kind]}{f' of {choices}' if choices else ''}")
    return ScalarField("", kind, doc, optional, default, tuple(choices))


def array(
    dtype: str,
    shape: str,
    doc: str,
    *,
    unit: str = "",
    default: None = _MISSING,
    optional: bool = False,
) -> Any:
    """Declares an array field. `dtype` and `shape` list alternatives with `|`: `array("uint8", "H W 3|H W", ...)`.

    `default=None` makes it optional: it may be None.

    Symbols begin with a capital letter; `N` in two fields of one message means the same extent.
    """
    shapes = tuple(
        tuple(int(word) if word.isdigit() else word for word in alternative.split()) for alternative in shape.split("|")
    )
    for extent in (e for s in shapes for e in s if isinstance(e, str)):
        if not SYMBOL.fullmatch(extent):
            raise MessageError(f"array shape {shape!r}: {extent!r} is neither a number nor a capitalised symbol")
    dtypes = tuple(np.dtype(d.strip()).newbyteorder("<") for d in dtype.split("|"))
    return ArrayField("", dtypes, shapes, doc, unit, optional or default is None)


_registry: dict[str, type[Message]] = {}


def message_types() -> Mapping[str, type[Message]]:
    """Every declared message class by its schema name."""
    import dataflow.messages  # noqa: F401  (declares the built-in families)

    return dict(_registry)


def message_type(schema: str) -> type[Message]:
    """The class of a schema name such as `"DepthImage"`; raises `MessageError` for an unknown one."""
    found = _registry.get(schema) or message_types().get(schema)
    if found is None:
        raise MessageError(f"unknown message schema {schema!r}; known: {', '.join(sorted(_registry))}")
    return found


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(scalar, array))
class _Declared:
    """Tells type checkers that the fields of a class below are the keywords of its constructor."""


class Message(_Declared):
    """One immutable value of a stream.

    Every message has `stamp`: event time, integer nanoseconds since the epoch. Subclasses declare further fields with
    `scalar` and `array`; the schema name is the class name unless `schema="..."` is given as a class argument.
    """

    SCHEMA: ClassVar[str] = ""
    FIELDS: ClassVar[tuple[Field, ...]] = ()
    SCALARS: ClassVar[tuple[ScalarField, ...]] = ()
    ARRAYS: ClassVar[tuple[ArrayField, ...]] = ()
    _names: ClassVar[frozenset[str]] = frozenset()

    stamp: int

    def __init_subclass__(cls, schema: str | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        own = []
        for name, value in list(vars(cls).items()):
            if isinstance(value, (ScalarField, ArrayField)):
                if name == "stamp" or hasattr(Message, name):
                    raise MessageError(f"{cls.__name__}.{name}: every message has {name!r} already; use another name")
                own.append(type(value)(name, *(getattr(value, s) for s in value.__slots__[1:])))
                delattr(cls, name)
        cls.FIELDS = (*cls.FIELDS, *own)
        cls.SCALARS = tuple(f for f in cls.FIELDS if isinstance(f, ScalarField))
        cls.ARRAYS = tuple(f for f in cls.FIELDS if isinstance(f, ArrayField))
        cls._names = frozenset(f.name for f in cls.FIELDS)
        cls.SCHEMA = schema or cls.__name__
        known = _registry.get(cls.SCHEMA)
        if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise MessageError(f"message schema {cls.SCHEMA!r} is declared twice: by {known!r} and by {cls!r}")
        _registry[cls.SCHEMA] = cls

    def __init__(self, *, stamp: int, **values: Any) -> None:
        cls = type(self)
        state = self.__dict__
        state["stamp"] = _stamp(cls.SCHEMA, stamp)
        unknown = values.keys() - cls._names
        if unknown:
            raise MessageError(
                f"{cls.SCHEMA} has no field {', '.join(sorted(map(repr, unknown)))}; "
                f"its fields: stamp, {', '.join(f.name for f in cls.FIELDS)}"
            )
        for spec in cls.SCALARS:
            state[spec.name] = _scalar(cls.SCHEMA, spec, values.get(spec.name, _MISSING))
        extents: dict[str, tuple[int, str]] = {}
        for aspec in cls.ARRAYS:
            state[aspec.name] = _array(cls.SCHEMA, aspec, values.get(aspec.name), extents)
        self.validate()

    def validate(self) -> None:
        """Checks what the declaration cannot say (value ranges, relations between fields). Overridden by subclasses.

        Raises `MessageError`.
        """

    @classmethod
    def from_parts(cls, stamp: int, header: Sequence[Scalar | None], arrays: Sequence[npt.NDArray[Any] | None]) -> Self:
        """A message around already frozen arrays, in declaration order, without copying them: the decoder's way in.

        The arrays must be views of memory that nobody writes to. Everything is validated as in the constructor.
        """
        if len(header) != len(cls.SCALARS) or len(arrays) != len(cls.ARRAYS):
            raise MessageError(
                f"{cls.SCHEMA} takes {len(cls.SCALARS)} header fields and {len(cls.ARRAYS)} arrays, "
                f"got {len(header)} and {len(arrays)}"
            )
        self = cls.__new__(cls)
        state = self.__dict__
        state["stamp"] = _stamp(cls.SCHEMA, stamp)
        for spec, value in zip(cls.SCALARS, header, strict=True):
            if value is None and not spec.optional:
                raise MessageError(f"{cls.SCHEMA}.{spec.name} is required, got None")
            state[spec.name] = _scalar(cls.SCHEMA, spec, value)
        extents: dict[str, tuple[int, str]] = {}
        for aspec, data in zip(cls.ARRAYS, arrays, strict=True):
            if data is not None and (
                data.dtype not in aspec.dtypes or not data.flags.c_contiguous or data.flags.writeable
            ):
                raise MessageError(
                    f"{cls.SCHEMA}.{aspec.name}: a decoded array must be frozen, C-contiguous {aspec.dtype_text()}, "
                    f"got {data.dtype}"
                )
            _check_shape(cls.SCHEMA, aspec, data, extents)
            state[aspec.name] = data
        self.validate()
        return self

    def header(self) -> tuple[Scalar | None, ...]:
        """The scalar fields in declaration order."""
        return tuple(self.__dict__[f.name] for f in self.SCALARS)

    def arrays(self) -> tuple[npt.NDArray[Any] | None, ...]:
        """The array fields in declaration order."""
        return tuple(self.__dict__[f.name] for f in self.ARRAYS)

    def nbytes(self) -> int:
        """Bytes held in arrays."""
        return sum(a.nbytes for a in self.arrays() if a is not None)

    def digest(self) -> bytes:
        """xxh3-128 (16 bytes) over schema, stamp, header fields and, per array, dtype, shape and bytes."""
        cached: bytes | None = self.__dict__.get("_digest")
        if cached is None:
            cached = self.__dict__["_digest"] = self.compute_digest()
        return cached

    def compute_digest(self) -> bytes:
        """The digest computed afresh: a difference from `digest()` means that somebody changed frozen memory."""
        h = xxhash.xxh3_128()
        h.update(b"".join(_canonical_head(self)))
        for data in self.arrays():
            if data is None:
                h.update(b"\x00")
            else:
                shape = data.shape
                h.update(b"\x01" + data.dtype.str.encode() + struct.pack(f"<B{len(shape)}q", len(shape), *shape))
                if data.size:
                    h.update(data.data.cast("B"))
        return h.digest()

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed."""
        values = {f.name: self.__dict__[f.name] for f in self.FIELDS}
        return type(self)(**({"stamp": self.stamp} | values | changes))

    def items(self) -> Iterator[tuple[str, Scalar | npt.NDArray[Any] | None]]:
        """(field name, value) of every field, the stamp first."""
        yield "stamp", self.stamp
        for f in self.FIELDS:
            yield f.name, self.__dict__[f.name]

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{type(self).__name__} is immutable; use replace({name}=...)")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{type(self).__name__} is immutable")

    def __eq__(self, other: object) -> bool:
        """Bitwise equality: equal digests."""
        if not isinstance(other, Message):
            return NotImplemented
        return self.digest() == other.digest()

    def __hash__(self) -> int:
        return hash(self.digest())

    def __copy__(self) -> Self:
        return self

    def __deepcopy__(self, memo: object) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by value and remade by the constructor, so that the arrays come back frozen."""
        return _remake, (type(self), dict(self.items()))

    def __repr__(self) -> str:
        words = [f"stamp={self.stamp}"]
        for f in self.FIELDS:
            value = self.__dict__[f.name]
            if isinstance(value, np.ndarray):
                words.append(f"{f.name}={value.dtype}{list(value.shape)}")
            elif value is not None:
                words.append(f"{f.name}={value!r}")
        return f"{type(self).__name__}({', '.join(words)})"


def _remake(cls: type[Message], values: dict[str, Any]) -> Message:
    return cls(**values)


def _stamp(schema: str, stamp: Any) -> int:
    if isinstance(stamp, (bool, float, str)) or not hasattr(stamp, "__index__"):
        raise MessageError(f"{schema}.stamp must be an integer (nanoseconds since the epoch), got {stamp!r}")
    value = int(stamp)
    if not _INT64_MIN < value < _INT64_MAX:
        raise MessageError(f"{schema}.stamp {value} is outside the 64-bit range of nanoseconds")
    return value


def _scalar(schema: str, spec: ScalarField, value: Any) -> Scalar | None:
    if value is _MISSING:
        if spec.required:
            raise MessageError(f"{schema}.{spec.name} is required ({_PYTHON_NAME[spec.kind]}: {spec.doc})")
        return None if spec.default is _MISSING else spec.default
    if value is None:
        if spec.optional:
            return None
        raise MessageError(f"{schema}.{spec.name} must be a {_PYTHON_NAME[spec.kind]}, got None")
    converted = _canonical_scalar(spec.kind, value)
    if converted is None:
        raise MessageError(
            f"{schema}.{spec.name} must be a {_PYTHON_NAME[spec.kind]} ({spec.doc}), got {value!r} "
            f"({type(value).__name__})"
        )
    if spec.choices and converted not in spec.choices:
        raise MessageError(f"{schema}.{spec.name} must be one of {', '.join(spec.choices)}, got {value!r}")
    return converted


def _canonical_scalar(kind: ScalarKind, value: Any) -> Scalar | None:
    """`value` as the declared Python type, or None when it is of another kind."""
    match kind:
        case "bool":
            return bool(value) if isinstance(value, (bool, np.bool_)) else None
        case "int":
            if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
                whole = int(value)
                return whole if _INT64_MIN <= whole <= _INT64_MAX else None
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
            words = tuple(str(v) for v in value if isinstance(v, str) and _is_utf8(v))
            return words if len(words) == len(value) else None


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _array(schema: str, spec: ArrayField, value: Any, extents: dict[str, tuple[int, str]]) -> npt.NDArray[Any] | None:
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
    frozen: npt.NDArray[Any] = np.array(data, dtype=dtype, order="C", copy=True)
    if dtype.kind in "iu" and data.dtype != dtype and not np.array_equal(frozen, data):
        raise MessageError(
            f"{schema}.{spec.name} must be {spec.dtype_text()}, got {data.dtype} with values that do not fit: "
            f"{data.min()} to {data.max()}"
        )
    frozen.flags.writeable = False
    _check_shape(schema, spec, frozen, extents)
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


def _check_shape(
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


def _canonical_head(message: Message) -> Iterator[bytes]:
    """The bytes of schema, stamp and header fields that the digest covers; strings and lists carry their length."""
    schema = message.SCHEMA.encode()
    yield struct.pack("<I", len(schema)) + schema + struct.pack("<q", message.stamp)
    for value in message.header():
        match value:
            case None:
                yield b"n"
            case bool():
                yield b"T" if value else b"F"
            case int():
                yield b"i" + struct.pack("<q", value)
            case float():
                yield b"f" + struct.pack("<d", value)
            case str():
                text = value.encode()
                yield b"s" + struct.pack("<I", len(text)) + text
            case tuple():
                yield b"l" + struct.pack("<I", len(value))
                for word in value:
                    text = word.encode()
                    yield struct.pack("<I", len(text)) + text
