"""A message type as plain data, so that a process without the type's module can read and write its messages."""

from __future__ import annotations

import inspect
import json
import keyword
import types
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

from dataflow.messages.base import Message, registered_type, type_path
from dataflow.messages.fields.declared import (
    MISSING,
    SYMBOL,
    TAKEN,
    ArrayField,
    Field,
    MessageError,
    ScalarField,
    ScalarKind,
    canonical_scalar,
    little_endian,
)

_BITS = ("8", "16", "32", "64")
DTYPES = frozenset(
    ["bool", *("int" + n for n in _BITS), *("uint" + n for n in _BITS), *("float" + n for n in _BITS[1:])]
)
KINDS = ("bool", "int", "float", "str", "strs")
MAX_FIELDS = 256
MAX_DIMENSIONS = 16


@dataclass(frozen=True, slots=True)
class Declaration:
    """The schema name of a message type, its import path (`module:Class`), its documentation and its fields."""

    schema: str
    path: str
    doc: str
    fields: tuple[Field, ...]

    @classmethod
    def of(cls, message: type[Message]) -> Declaration:
        """The declaration of a class; a class made by `generic_type` gives the one that it was made from."""
        if issubclass(message, GenericMessage):
            return message.DECLARATION
        return cls(message.SCHEMA, type_path(message), inspect.cleandoc(message.__doc__ or ""), message.FIELDS)

    def to_json(self) -> dict[str, Any]:
        """JSON values; `from_json` rebuilds the declaration."""
        return {
            "schema": self.schema,
            "path": self.path,
            "doc": self.doc,
            "fields": [_field_to_json(field) for field in self.fields],
        }

    @classmethod
    def from_json(cls, data: Any) -> Declaration:
        """The declaration that `to_json` described. Raises `MessageError` for anything else."""
        try:
            schema, path, doc = (_text(data[name]) for name in ("schema", "path", "doc"))
            if not schema or len(data["fields"]) > MAX_FIELDS:
                raise ValueError(f"schema {schema!r} with {len(data['fields'])} fields")
            fields = tuple(_field_from_json(values) for values in data["fields"])
            names = [field.name for field in fields]
            if len(set(names)) < len(names):
                raise ValueError(f"a field is declared twice: {', '.join(names)}")
            return cls(schema, path, doc, fields)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise MessageError(f"not the declaration of a message type: {type(error).__name__}: {error}") from error

    def differences(self, other: Declaration, mine_is: str = "one", other_is: str = "the other") -> list[str]:
        """One line for each field that is in one of the two only, or in another form, or in another order.

        `mine_is`, `other_is` name the two declarations in these lines.
        """
        mine = {f.name: field_text(f) for f in self.fields}
        theirs = {f.name: field_text(f) for f in other.fields}
        found = [
            f"field {name!r} is {form} in {mine_is} and {theirs.get(name, 'missing')} in {other_is}"
            for name, form in mine.items()
            if theirs.get(name) != form
        ]
        found += [
            f"field {name!r} is missing in {mine_is} and {form} in {other_is}"
            for name, form in theirs.items()
            if name not in mine
        ]
        if not found and list(mine) != list(theirs):
            orders = f"{', '.join(mine)} in {mine_is} and {', '.join(theirs)} in {other_is}"
            found = [f"the fields are in the order {orders}"]
        return found


class GenericMessage(Message):
    """A message of a type that is known by its declaration alone.

    It has the fields of the type, encodes to the same bytes and has the same digest; the type's own checks, properties
    and methods are in the module that declares it, which was not imported.
    """

    DECLARATION: ClassVar[Declaration]

    @classmethod
    def _register(cls) -> None:
        """Leaves the schema name to the module that declares the type."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled with the declaration: the class itself has no import path."""
        return _remake, (json.dumps(self.DECLARATION.to_json()), dict(self.items()))


def known_type(declaration: Declaration) -> type[Message]:
    """The class that messages of a declared type are read as.

    That is the class of this program where it has one with the same fields; else one made from the declaration.
    """
    return _read_as(registered_type(declaration.schema), declaration)  # type: ignore[arg-type]


@lru_cache(maxsize=256)
def _read_as(found: type[Message] | None, declaration: Declaration) -> type[Message]:
    if found is not None and not Declaration.of(found).differences(declaration):
        return found
    return generic_type(declaration)


def generic_type(declaration: Declaration) -> type[GenericMessage]:
    """A message class made from a declaration alone; one and the same for equal declarations."""
    return _generic_type(json.dumps(declaration.to_json()))


@lru_cache(maxsize=256)
def _generic_type(text: str) -> type[GenericMessage]:
    declaration = Declaration.from_json(json.loads(text))

    def body(namespace: dict[str, Any]) -> None:
        namespace["__module__"] = declaration.path.partition(":")[0]
        namespace["__doc__"] = declaration.doc
        namespace["DECLARATION"] = declaration
        namespace.update((field.name, field) for field in declaration.fields)

    name = declaration.path.rpartition(":")[2].rpartition(".")[2] or declaration.schema
    made = types.new_class(name, (GenericMessage,), {"schema": declaration.schema}, body)
    assert issubclass(made, GenericMessage)
    return made


def _remake(text: str, values: Mapping[str, Any]) -> GenericMessage:
    return _generic_type(text)(**values)


def field_text(field: Field) -> str:
    """The form of a field in words: `float32 (N, 3)`, `int or None`."""
    kind = f"{field.dtype_text()} {field.shape_text()}" if isinstance(field, ArrayField) else field.kind
    return f"{kind}{' or None' if field.optional else ''}"


def _field_to_json(field: Field) -> dict[str, Any]:
    values: dict[str, Any] = {"name": field.name, "doc": field.doc, "optional": field.optional}
    if field.added:
        values["added"] = True
    if isinstance(field, ArrayField):
        shapes = [list(shape) for shape in field.shapes]
        return values | {"dtypes": [d.name for d in field.dtypes], "shapes": shapes, "unit": field.unit}
    values |= {"kind": field.kind, "choices": list(field.choices)}
    if field.default is not MISSING:
        values["default"] = field.default.hex() if isinstance(field.default, float) else field.default
    return values


def _field_from_json(values: Any) -> Field:
    name, doc, optional = _text(values["name"]), _text(values["doc"]), values["optional"]
    usable = name.isidentifier() and not name.startswith("_") and not keyword.iskeyword(name)
    if not usable or name in (*TAKEN, "DECLARATION") or hasattr(GenericMessage, name):
        raise ValueError(f"{name!r} cannot name a field")
    added = values.get("added", False)
    if not isinstance(optional, bool) or not isinstance(added, bool):
        raise TypeError(f"field {name!r}: optional is {optional!r}, added is {added!r}")
    if "kind" in values:
        return replace(_scalar_from_json(name, doc, optional, values), added=added)
    dtypes = tuple(little_endian(_one_of(name, d, DTYPES)) for d in values["dtypes"])
    shapes = tuple(tuple(_extent(name, extent) for extent in shape) for shape in values["shapes"])
    if not dtypes or not shapes or any(len(shape) > MAX_DIMENSIONS for shape in shapes):
        raise ValueError(f"field {name!r} has dtypes {values['dtypes']} and shapes {values['shapes']}")
    return ArrayField(name, dtypes, shapes, doc, _text(values["unit"]), optional, added)


def _scalar_from_json(name: str, doc: str, optional: bool, values: Mapping[str, Any]) -> ScalarField:
    kind: ScalarKind = _one_of(name, values["kind"], KINDS)
    default = values.get("default", MISSING)
    if default is not MISSING and default is not None:
        default = canonical_scalar(kind, float.fromhex(default) if kind == "float" else default)
        if default is None:
            raise ValueError(f"field {name!r}: the default {values['default']!r} is not a {kind}")
    return ScalarField(name, kind, doc, optional, default, tuple(_text(choice) for choice in values["choices"]))


def _extent(name: str, extent: Any) -> int | str:
    if isinstance(extent, str) and SYMBOL.fullmatch(extent):
        return extent
    if isinstance(extent, int) and not isinstance(extent, bool) and extent >= 0:
        return extent
    raise ValueError(f"field {name!r}: extent {extent!r} is neither a number nor a capitalised symbol")


def _one_of(name: str, word: Any, words: Collection[str]) -> Any:
    if word not in words:
        raise ValueError(f"field {name!r}: {word!r} is none of {', '.join(sorted(words))}")
    return word


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected a string, got {value!r}")
    return value
