"""Message types as plain data: what travels with graphs and recordings, and the classes made from it."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from example_messages import example
from hypothesis import given
from hypothesis import strategies as st

from dataflow.messages import Image, Message, MessageError, array, message_type, message_types, scalar
from dataflow.messages import base as registry
from dataflow.messages.base import import_type, is_built_in, type_path
from dataflow.messages.declaration import Declaration, GenericMessage, generic_type, known_type

BUILT_IN = [cls for cls in message_types().values() if is_built_in(cls)]


class Brightness(Message, schema="tests.declaration.Brightness"):
    """Says how bright an image is."""

    mean: float = scalar("float", "mean grey value")
    quality: str = scalar("str", "how sure that is", choices=("low", "high"), default="low")
    limit: float = scalar("float", "the value that it must not pass", default=float("nan"))
    tags: tuple[str, ...] = scalar("strs", "words about it", default=("a", "b"))
    count: int | None = scalar("int", "pixels", default=None)
    histogram: Any = array("int64|int32", "8|N 2", "pixels by brightness", unit="pixels")
    corners: Any = array("float32", "N 3", "where", default=None)

    @property
    def bright(self) -> bool:
        return self.mean > 100


def bright(stamp: int = 5, **changes: Any) -> Brightness:
    values = {"mean": 3.5, "histogram": np.arange(8)} | changes
    return Brightness(stamp=stamp, **values)


def copied(declaration: Declaration) -> Declaration:
    return Declaration.from_json(json.loads(json.dumps(declaration.to_json(), allow_nan=False)))


@pytest.fixture
def unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a process that has not imported this module."""
    monkeypatch.delitem(registry._registry, Brightness.SCHEMA)


@pytest.mark.parametrize("cls", [*BUILT_IN, Brightness], ids=lambda cls: cls.SCHEMA)
def test_a_class_made_from_the_declaration_gives_the_same_messages(cls: type[Message]) -> None:
    declaration = copied(Declaration.of(cls))
    made = generic_type(declaration)
    assert declaration.differences(Declaration.of(cls)) == []
    assert (made.SCHEMA, made.__doc__, type_path(made)) == (cls.SCHEMA, declaration.doc, type_path(cls))
    for seed in range(4):
        message = example(cls, seed)
        again = made.from_parts(message.stamp, message.header(), message.arrays())
        assert again.digest() == message.digest()
        assert repr(dict(again.items())) == repr(dict(message.items()))


def test_defaults_come_along() -> None:
    made = generic_type(copied(Declaration.of(Brightness)))
    assert made(stamp=5, mean=3.5, histogram=np.arange(8)).digest() == bright().digest()
    with pytest.raises(MessageError, match="must be one of low, high"):
        made(stamp=5, mean=3.5, histogram=np.arange(8), quality="so-so")


def test_a_class_is_made_once_and_is_not_registered() -> None:
    declaration = copied(Declaration.of(Brightness))
    made = generic_type(declaration)
    assert generic_type(copied(Declaration.of(made))) is made
    assert message_type(Brightness.SCHEMA) is Brightness
    assert made not in message_types().values()


def test_messages_of_such_a_class_are_pickled_with_it() -> None:
    made = generic_type(Declaration.of(Brightness))
    message = made(stamp=5, mean=3.5, histogram=np.arange(8))
    again = pickle.loads(pickle.dumps(message))
    assert type(again) is made
    assert again == message


def test_the_class_of_this_process_is_taken_where_its_fields_are_the_same() -> None:
    assert known_type(copied(Declaration.of(Brightness))) is Brightness


@pytest.mark.usefixtures("unknown")
def test_without_the_module_the_class_is_made() -> None:
    found = known_type(Declaration.of(Brightness))
    assert issubclass(found, GenericMessage)
    assert not hasattr(found, "bright")


def test_a_class_of_other_fields_is_not_taken() -> None:
    values = Declaration.of(Brightness).to_json()
    values["fields"][0]["kind"] = "int"
    older = Declaration.from_json(values)
    assert issubclass(known_type(older), GenericMessage)
    assert Declaration.of(Brightness).differences(older, "the module", "the recording") == [
        "field 'mean' is float in the module and int in the recording"
    ]


def test_differences_name_fields_and_both_forms() -> None:
    values = Declaration.of(Brightness).to_json()
    fields = {field["name"]: field for field in values["fields"]}
    fields["histogram"]["dtypes"] = ["float32"]
    fields["new"] = {"name": "new", "kind": "bool", "doc": "", "optional": True, "default": None, "choices": []}
    del fields["tags"]
    other = Declaration.from_json(values | {"fields": list(fields.values())})
    assert Declaration.of(Brightness).differences(other, "A", "B") == [
        "field 'tags' is strs in A and missing in B",
        "field 'histogram' is int64 or int32 (8,) or (N, 2) in A and float32 (8,) or (N, 2) in B",
        "field 'new' is missing in A and bool or None in B",
    ]
    turned = Declaration.from_json(values | {"fields": values["fields"][::-1]})
    (line,) = Declaration.from_json(values).differences(turned)
    assert line.startswith("the fields are in the order mean, quality, limit")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
PLACES = st.sampled_from(["schema", "path", "doc", "fields"])
KEYS = st.sampled_from(["name", "kind", "doc", "optional", "default", "choices", "dtypes", "shapes", "unit"])


@given(PLACES, KEYS, st.integers(0, 6), JSON)
def test_a_damaged_declaration_is_refused_or_makes_a_class(place: str, key: str, index: int, value: Any) -> None:
    whole = Declaration.of(Brightness).to_json()
    field = {**whole["fields"][index], key: value}
    for damaged in ({**whole, place: value}, {**whole, "fields": [*whole["fields"][:index], field]}, value):
        try:
            declaration = Declaration.from_json(damaged)
        except MessageError:
            continue
        assert copied(declaration).to_json() == declaration.to_json()
        generic_type(declaration)


@pytest.mark.parametrize("name", ["stamp", "digest", "class", "a b", "DECLARATION", "__init__", "_digest", "timestamp"])
def test_a_field_cannot_take_a_name_that_messages_use(name: str) -> None:
    whole = Declaration.of(Brightness).to_json()
    whole["fields"][0]["name"] = name
    with pytest.raises(MessageError, match="cannot name a field"):
        Declaration.from_json(whole)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder whose modules can be imported."""
    known = dict(registry._registry)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    registry._registry.clear()
    registry._registry.update(known)


def write(folder: Path, module: str, body: str) -> ModuleType | None:
    (folder / f"{module}.py").write_text(f"from dataflow.messages import Message, scalar\n{body}\n")
    return None


def test_two_types_of_one_name_are_refused_with_both_places(folder: Path) -> None:
    write(folder, "first_types", "class Glow(Message):\n    x: int = scalar('int', 'x')")
    write(folder, "second_types", "class Glow(Message):\n    x: int = scalar('int', 'x')")
    import_type("first_types:Glow", "Glow")
    with pytest.raises(MessageError, match=r"'Glow' is declared twice") as caught:
        import_type("second_types:Glow", "Glow")
    for place in ("first_types:Glow", "second_types:Glow", "first_types.py", "second_types.py"):
        assert place in str(caught.value)


def test_a_type_of_ours_cannot_be_declared_again() -> None:
    with pytest.raises(MessageError, match=r"dataflow\.messages\.images:Image .*images\.py"):
        type("Image", (Message,), {"__module__": "elsewhere"})
    assert message_type("Image") is Image


def test_a_module_that_does_not_declare_the_type_is_named(folder: Path) -> None:
    write(folder, "empty_types", "")
    with pytest.raises(MessageError, match=r"'empty_types' declares no message type 'Glimmer'"):
        import_type("empty_types:Glimmer", "Glimmer")
    with pytest.raises(MessageError, match=r"'absent_types:Glimmer', which cannot be imported: ModuleNotFoundError"):
        import_type("absent_types:Glimmer", "Glimmer")


def test_dtypes_are_the_objects_that_numpy_has_for_them() -> None:
    """Decoders make arrays of a field's dtype, and the quick way into a message tells dtypes by identity."""
    for cls in (cls for cls in message_types().values() if cls.__module__.startswith("dataflow.")):
        again = Declaration.from_json(Declaration.of(cls).to_json())
        for field in (*cls.FIELDS, *again.fields):
            for dtype in getattr(field, "dtypes", ()):
                assert dtype is np.dtype(dtype.str)
                assert np.array([0], dtype).dtype is np.frombuffer(bytes(8), dtype).dtype
