"""A recording of types that are not of `dataflow.messages` opens without the module that declares them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from example_messages import example
from made_recordings import recorded

from dataflow.messages import Message, array, scalar
from dataflow.messages import base as registry
from dataflow.messages.declaration import Declaration, GenericMessage, generic_type
from dataflow.recording import Recording, describe
from dataflow.recording.layout import DIGESTS
from dataflow.recording.streams import writer
from dataflow.recording.streams.diff import diff


class Beacon(Message, schema="tests.own.Beacon"):
    """A light that was seen."""

    name: str = scalar("str", "which one")
    strength: float | None = scalar("float", "how bright", default=None)
    positions: Any = array("float32", "N 3", "where it was seen", unit="m")


def messages() -> list[Beacon]:
    return [example(Beacon, seed).replace(stamp=seed + 1) for seed in range(4)]


def write(path: Path, made: list[Any]) -> Path:
    return recorded(path, [("lamp/beacon", message) for message in made])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "own.mcap", messages())


@pytest.fixture
def unknown(monkeypatch: pytest.MonkeyPatch, path: Path) -> Iterator[None]:
    """As in a process that has not imported this module."""
    with monkeypatch.context() as patched:
        patched.delitem(registry._registry, Beacon.SCHEMA)
        yield


def test_with_the_module_messages_are_of_its_class(path: Path) -> None:
    with Recording(path) as recording:
        info = recording.streams["lamp/beacon"]
        assert (info.message_type, info.generic, info.declared_otherwise) == (Beacon, False, False)
        assert [m.message for m in recording.messages()] == messages()


@pytest.mark.usefixtures("unknown")
def test_without_the_module_messages_have_the_same_fields_and_digests(path: Path) -> None:
    with Recording(path) as recording:
        info = recording.streams["lamp/beacon"]
        assert (info.generic, info.declared_otherwise) == (True, False)
        found = [m.message for m in recording.messages()]
        assert dict(recording.digests()) == recording.metadata[DIGESTS]
        assert [s.generic for s in describe(recording).streams] == [True]
    assert all(isinstance(m, GenericMessage) for m in found)
    assert found == messages()
    with Recording(path) as a, Recording(path) as b:
        assert diff(a, b).same


@pytest.mark.usefixtures("unknown")
def test_file_written_without_the_module_is_identical(path: Path, tmp_path: Path) -> None:
    with Recording(path) as recording:
        again = write(tmp_path / "again.mcap", [m.message for m in recording.messages()])
    assert again.read_bytes() == path.read_bytes()


def test_a_module_that_is_imported_later_counts_from_then(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.delitem(registry._registry, Beacon.SCHEMA)
        recording = Recording(path)
        assert isinstance(next(recording.messages()).message, GenericMessage)
    with recording:
        assert type(next(recording.messages()).message) is Beacon
        assert recording.streams["lamp/beacon"].message_type is Beacon


def test_a_class_whose_fields_have_changed_is_not_used(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.delitem(registry._registry, Beacon.SCHEMA)

        class Changed(Message, schema="tests.own.Beacon"):
            name: str = scalar("str", "which one")

        with Recording(path) as recording:
            info = recording.streams["lamp/beacon"]
            assert (info.generic, info.declared_otherwise) == (True, True)
            assert [m.message for m in recording.messages()] == messages()
        del registry._registry["tests.own.Beacon"]
        patched.setitem(registry._registry, Beacon.SCHEMA, Beacon)


def test_two_declarations_of_one_type_differ_by_name_of_field(path: Path, tmp_path: Path) -> None:
    values = Declaration.of(Beacon).to_json()
    values["fields"][2]["dtypes"] = ["float64"]
    made = generic_type(Declaration.from_json(values))
    other = write(tmp_path / "other.mcap", [made(**dict(m.items())) for m in messages()])
    with Recording(path) as a, Recording(other) as b:
        (stream,) = diff(a, b).streams
    assert stream.first is not None
    assert "field 'positions' is float32 (N, 3) in A and float64 (N, 3) in B" in stream.first.detail


def test_a_declaration_that_cannot_be_read_leaves_the_rest_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As another version of this program may write it."""
    declared = writer.declaration_metadata
    with monkeypatch.context() as patched:
        patched.setattr(writer, "declaration_metadata", lambda kind: {**declared(kind), "fields": "?"})
        path = write(tmp_path / "other.mcap", messages())
    with Recording(path) as recording:
        info = recording.streams["lamp/beacon"]
        assert info.metadata["fields"] == "?"
        assert info.declaration is None
        assert info.message_type is Beacon  # by the name alone, as of any other type


def test_types_of_dataflow_messages_carry_no_declaration(tmp_path: Path) -> None:
    from dataflow.messages import Number

    path = write(tmp_path / "number.mcap", [Number(stamp=1, value=np.pi)])
    with Recording(path) as recording:
        assert "fields" not in recording.streams["lamp/beacon"].metadata
