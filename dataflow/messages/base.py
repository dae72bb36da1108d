"""The base of every message: declared fields, canonical form, immutability and the digest.

A message class declares its fields once; construction validates them and brings them into canonical form
(C-contiguous little-endian arrays of the declared dtype, scalars of the declared Python type), so that equal values
have equal digests wherever and however they were made.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Self, dataclass_transform

import numpy as np
import numpy.typing as npt

from dataflow.messages.fields.compiled import Compiled, compile_class
from dataflow.messages.fields.declared import (
    ANCHOR,
    MISSING,
    SYMBOL,
    TAKEN,
    ArrayField,
    Field,
    MessageError,
    Scalar,
    ScalarField,
    ScalarKind,
    array,
    array_value,
    canonical_stamp,
    check_shape,
    scalar,
    scalar_value,
)

__all__ = [
    "ANCHOR",
    "SYMBOL",
    "ArrayField",
    "Field",
    "Message",
    "MessageError",
    "Scalar",
    "ScalarField",
    "ScalarKind",
    "array",
    "complete",
    "import_type",
    "is_built_in",
    "lacking",
    "message_type",
    "message_types",
    "registered_type",
    "scalar",
    "type_path",
]

_registry: dict[str, type[Message]] = {}


def message_types() -> Mapping[str, type[Message]]:
    """Every declared message class by its schema name."""
    import dataflow.messages  # noqa: F401  (declares the built-in families)

    return dict(_registry)


def registered_type(schema: str) -> type[Message] | None:
    """The class of a schema name, or None where this process has imported none that declares it."""
    return _registry.get(schema) or message_types().get(schema)


def message_type(schema: str) -> type[Message]:
    """The class of a schema name such as `"DepthImage"`; raises `MessageError` for an unknown one."""
    found = _registry.get(schema) or registered_type(schema)
    if found is None:
        raise MessageError(f"unknown message schema {schema!r}; known: {', '.join(sorted(_registry))}")
    return found


def type_path(message: type[Message]) -> str:
    """The import path of a message class: `"my_robot.types:Brightness"`."""
    return f"{message.__module__}:{message.__qualname__}"


def is_built_in(message: type[Message]) -> bool:
    """Returns whether the class is one of `dataflow.messages`, which every process has."""
    return message is Message or message.__module__.startswith("dataflow.messages.")


def import_type(path: str, schema: str) -> type[Message]:
    """The message class of a schema, after importing the module of its `type_path`. Raises `MessageError`."""
    found = _registry.get(schema)
    if found is not None and type_path(found) == path:
        return found
    module = path.partition(":")[0]
    try:
        importlib.import_module(module)
    except (Exception, SystemExit) as error:  # a module may fail in any way when it runs
        raise MessageError(
            f"message type {schema!r} is declared by {path!r}, which cannot be imported: "
            f"{type(error).__name__}: {error}"
        ) from error
    found = _registry.get(schema)
    if found is None:
        raise MessageError(f"module {module!r} declares no message type {schema!r} ({path!r}) when it is imported")
    if type_path(found) != path:
        raise MessageError(f"message schema {schema!r} is declared by {_place(found)} here, expected {path!r}")
    return found


class _NotGiven:
    """Stands on the class for a field that a message was constructed without: reading it is an error."""

    def __init__(self, name: str, filled: str) -> None:
        self._name, self._filled = name, filled

    def __get__(self, message: Message | None, owner: type[Message]) -> Any:
        if message is None:
            return self
        raise MessageError(
            f"{owner.SCHEMA} has no {self._name}: it is filled in with {self._filled} when process() returns the "
            f"message; before that, and anywhere else, give {self._name}=..."
        )


_NO_STAMP: Any = _NotGiven("stamp", "the firing's stamp")


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(scalar, array))
class _Declared:
    """Declares to type checkers that the fields of a class below are the keywords of its constructor."""


class Message(_Declared):
    """One immutable value of a stream.

    Every message has `stamp`: event time, integer nanoseconds since the epoch. Subclasses declare further fields with
    `scalar` and `array`; the schema name is the class name unless `schema="..."` is given as a class argument.

    A message that `process()` returns may be constructed without its stamp and without a field declared
    `default=ANCHOR`: they are filled in with the stamp of the firing and with the `frame` of the message that triggered
    it. Until then, reading them, comparing, encoding and the digest raise `MessageError`.
    """

    SCHEMA: ClassVar[str] = ""
    FIELDS: ClassVar[tuple[Field, ...]] = ()
    SCALARS: ClassVar[tuple[ScalarField, ...]] = ()
    ARRAYS: ClassVar[tuple[ArrayField, ...]] = ()
    _names: ClassVar[frozenset[str]] = frozenset()
    _filled: ClassVar[tuple[str, ...]] = ("stamp",)
    """Names of what may be left out at construction."""
    _made: ClassVar[Compiled | None] = None
    """The functions made for this class, as soon as they are needed."""

    stamp: int = _NO_STAMP

    def __init_subclass__(cls, schema: str | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        own = []
        for name, value in list(vars(cls).items()):
            if isinstance(value, (ScalarField, ArrayField)):
                if name in TAKEN or hasattr(Message, name):
                    raise MessageError(f"{cls.__name__}.{name}: every message has {name!r} already; use another name")
                if name.startswith("_"):
                    raise MessageError(f"{cls.__name__}.{name}: the name of a field begins with a letter")
                own.append(type(value)(name, *(getattr(value, s) for s in value.__slots__[1:])))
                if getattr(value, "anchored", False):
                    setattr(cls, name, _NotGiven(name, "the anchor's frame"))
                else:
                    delattr(cls, name)
        cls.FIELDS = (*cls.FIELDS, *own)
        cls.SCALARS = tuple(f for f in cls.FIELDS if isinstance(f, ScalarField))
        cls.ARRAYS = tuple(f for f in cls.FIELDS if isinstance(f, ArrayField))
        cls._names = frozenset(f.name for f in cls.FIELDS)
        cls._filled = ("stamp", *(f.name for f in cls.SCALARS if f.anchored))
        cls.SCHEMA = schema or cls.__name__
        cls._made = None
        cls._register()

    @classmethod
    def _register(cls) -> None:
        known = _registry.get(cls.SCHEMA)
        if known is not None and type_path(known) != type_path(cls):
            raise MessageError(
                f"message schema {cls.SCHEMA!r} is declared twice: by {_place(known)} and by {_place(cls)}; "
                f"rename one, or give it another schema name: class {cls.__name__}(Message, schema=...)"
            )
        _registry[cls.SCHEMA] = cls

    def __init__(self, *, stamp: int = MISSING, **values: Any) -> None:
        """Constructs a message from values of any accepted form. Raises `MessageError`.

        A class whose messages are constructed gets a compiled constructor, which falls back on this one.
        """
        cls = type(self)
        if cls._made is None:
            cls._compile()
        state = self.__dict__
        if stamp is not MISSING:
            state["stamp"] = canonical_stamp(cls.SCHEMA, stamp)
        unknown = values.keys() - cls._names
        if unknown:
            raise MessageError(
                f"{cls.SCHEMA} has no field {', '.join(sorted(map(repr, unknown)))}; "
                f"its fields: stamp, {', '.join(f.name for f in cls.FIELDS)}"
            )
        for spec in cls.SCALARS:
            value = values.get(spec.name, MISSING)
            if value is not MISSING or not spec.anchored:
                state[spec.name] = scalar_value(cls.SCHEMA, spec, value)
        extents: dict[str, tuple[int, str]] = {}
        for aspec in cls.ARRAYS:
            state[aspec.name] = array_value(cls.SCHEMA, aspec, values.get(aspec.name), extents)
        self.validate()

    @classmethod
    def compiled(cls) -> Compiled:
        """Returns the functions that are made for the class."""
        return cls._made or cls._compile()

    @classmethod
    def _compile(cls) -> Compiled:
        """Makes the functions of the class; its constructor too, unless the class defines one."""
        validates = cls.validate is not Message.validate
        cls._made = made = compile_class(
            cls, cls.SCHEMA, cls.SCALARS, cls.ARRAYS, Message.__init__, validates=validates
        )
        owner: Any = next(above for above in cls.__mro__ if "__init__" in vars(above))
        written = owner is not Message and (owner._made is None or vars(owner)["__init__"] is not owner._made.construct)
        if not written and made.construct is not None:
            type.__setattr__(cls, "__init__", made.construct)
        return made

    def validate(self) -> None:
        """Checks what the declaration cannot say (value ranges, relations between fields). Overridden by subclasses.

        Raises `MessageError`.
        """

    @classmethod
    def from_parts(cls, stamp: int, header: Sequence[Scalar | None], arrays: Sequence[npt.NDArray[Any] | None]) -> Self:
        """A message around already frozen arrays, in declaration order, without copying them: the decoder's way in.

        The arrays must be views of memory that does not change. Everything is validated as in the constructor.
        """
        self = cls.__new__(cls)
        if (cls._made or cls._compile()).adopt(self, stamp, header, arrays):
            return self
        if len(header) != len(cls.SCALARS) or len(arrays) != len(cls.ARRAYS):
            raise MessageError(
                f"{cls.SCHEMA} takes {len(cls.SCALARS)} header fields and {len(cls.ARRAYS)} arrays, "
                f"got {len(header)} and {len(arrays)}"
            )
        state = self.__dict__
        state["stamp"] = canonical_stamp(cls.SCHEMA, stamp)
        for spec, value in zip(cls.SCALARS, header, strict=True):
            if value is None and not spec.optional:
                raise MessageError(f"{cls.SCHEMA}.{spec.name} is required, got None")
            state[spec.name] = scalar_value(cls.SCHEMA, spec, value)
        extents: dict[str, tuple[int, str]] = {}
        for aspec, data in zip(cls.ARRAYS, arrays, strict=True):
            if data is not None and (
                data.dtype not in aspec.dtypes or not data.flags.c_contiguous or data.flags.writeable
            ):
                raise MessageError(
                    f"{cls.SCHEMA}.{aspec.name}: a decoded array must be frozen, C-contiguous {aspec.dtype_text()}, "
                    f"got {data.dtype}"
                )
            check_shape(cls.SCHEMA, aspec, data, extents)
            state[aspec.name] = data
        self.validate()
        return self

    def header(self) -> tuple[Scalar | None, ...]:
        """The scalar fields in declaration order."""
        return (self._made or self._compile()).header(self)

    def arrays(self) -> tuple[npt.NDArray[Any] | None, ...]:
        """The array fields in declaration order."""
        return (self._made or self._compile()).arrays(self)

    def nbytes(self) -> int:
        """Bytes held in arrays."""
        return sum(a.nbytes for a in self.arrays() if a is not None)

    def digest(self) -> bytes:
        """xxh3-128 (16 bytes) over schema, stamp, header fields and, per array, dtype, shape and bytes."""
        state = self.__dict__
        cached: bytes | None = state.get("_digest")
        if cached is None:
            cached = state["_digest"] = (self._made or self._compile()).digest(self)
        return cached

    def compute_digest(self) -> bytes:
        """The digest computed afresh: a difference from `digest()` means that frozen memory was changed."""
        return (self._made or self._compile()).digest(self)

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed."""
        return type(self)(**(self._given() | changes))

    def _given(self) -> dict[str, Any]:
        """The fields by name, the stamp first, without those that are not filled in yet."""
        return {
            name: self.__dict__[name] for name in ("stamp", *(f.name for f in self.FIELDS)) if name in self.__dict__
        }

    def items(self) -> Iterator[tuple[str, Scalar | npt.NDArray[Any] | None]]:
        """(field name, value) of every field, the stamp first."""
        yield "stamp", self.stamp
        for f in self.FIELDS:
            yield f.name, getattr(self, f.name)

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
        return _remake, (type(self), self._given())

    def _picture(self) -> tuple[str, bytes] | None:
        """The message as a picture, (format, file), for people; None for types that have none."""
        return None

    def _repr_html_(self) -> str:
        """HTML for notebooks."""
        from dataflow.messages.display.text import message_html

        return message_html(self.SCHEMA, self._given().items(), self._picture())

    def _repr_png_(self) -> bytes | None:
        """A PNG file for notebooks, of messages that can be drawn."""
        found = self._picture()
        return found[1] if found is not None and found[0] == "png" else None

    def __repr__(self) -> str:
        words = []
        for name, value in self._given().items():
            if isinstance(value, np.ndarray):
                words.append(f"{name}={value.dtype}{list(value.shape)}")
            elif value is not None:
                words.append(f"{name}={value!r}")
        return f"{type(self).__name__}({', '.join(words)})"


def lacking(message: Message) -> Sequence[str]:
    """Returns the names of what a message was constructed without and that is not filled in yet."""
    state = message.__dict__
    for name in message._filled:
        if name not in state:
            return [each for each in message._filled if each not in state]
    return ()


def complete(message: Message, stamp: int, frame: str) -> None:
    """Fills in what a message was constructed without; once, before anything reads it."""
    for name in lacking(message):
        message.__dict__[name] = stamp if name == "stamp" else frame


def _remake(cls: type[Message], values: dict[str, Any]) -> Message:
    return cls(**values)


def _place(message: type[Message]) -> str:
    """The import path of a class and the file it stands in, for people."""
    file = getattr(sys.modules.get(message.__module__), "__file__", None)
    return type_path(message) + (f" ({file})" if file else "")
