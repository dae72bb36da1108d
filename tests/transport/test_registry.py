"""The registry of running graphs: found while they run, gone when they are, and private to the user."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dataflow.transport.registry import RegistryError, register, registry_folder, running


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path / "dataflow"


def test_a_graph_is_found_while_it_runs() -> None:
    assert running() == []
    with register("demo", "robot1", ["tcp/127.0.0.1:7447"], {"nodes": [1]}) as entry, register("other", "robot2", []):
        assert [g.name for g in running()] == ["demo", "other"]
        assert running()[0] == entry
        assert entry.pid == os.getpid()
        assert running()[0].graph == {"nodes": [1]}
        assert entry.endpoints == ("tcp/127.0.0.1:7447",)
    assert running() == []


def test_registry_entry_of_a_killed_process_is_removed(peer: Callable[..., Any], folder: Path) -> None:
    child = peer("registered", "-")
    child.expect("up")
    assert [g.pid for g in running()] == [child.pid]
    child.kill()
    assert len(list(folder.iterdir())) == 1
    assert running() == []
    assert list(folder.iterdir()) == []


def test_another_process_with_the_same_id_is_not_mistaken_for_it(folder: Path) -> None:
    with register("demo", "robot1", []):
        path = next(folder.iterdir())
        entry = json.loads(path.read_text())
        path.write_text(json.dumps(entry | {"process_started": entry["process_started"] - 100}))
        assert running() == []


def test_files_that_are_no_entries_do_no_harm(folder: Path) -> None:
    registry_folder()
    (folder / f"{os.getpid()}-abc.new").write_text("{")
    (folder / "notes.json").write_text("[1]")
    (folder / "999999999-abc.new").write_text("{")
    assert running() == []
    assert sorted(p.name for p in folder.iterdir()) == [f"{os.getpid()}-abc.new", "notes.json"]


def test_a_folder_that_others_can_write_to_is_refused(folder: Path) -> None:
    assert registry_folder() == folder
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    with pytest.raises(RegistryError, match="mode 0700"):
        running()


def test_without_a_runtime_folder_the_temporary_one_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert registry_folder() == tmp_path / f"dataflow-{os.getuid()}"
