"""`dataflow reload`: what it compares before it orders a reload on another machine."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from dataflow.cli.commands.following.reload import _require_same_files, reload
from dataflow.client.processes import RequestRejected
from dataflow.execution.live import SET_UP_WITHIN
from dataflow.graph.code import digest_of


def test_files_that_differ_from_those_of_the_other_machine_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "edited_here.py").write_text("GAIN = 2\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))

    _require_same_files({"edited_here": digest_of(b"GAIN = 2\n"), "only_there": "0" * 64}, "arm")
    with pytest.raises(
        RequestRejected, match=r"edited_here on machine 'arm' differs from here: install it there first"
    ):
        _require_same_files({"edited_here": digest_of(b"GAIN = 1\n")}, "arm")


def test_a_reload_is_waited_for_until_its_import_and_setup_are_given_up() -> None:
    """Restoring a state that does not fit is followed by another `setup()`."""
    assert inspect.signature(reload).parameters["timeout"].default >= 3 * SET_UP_WITHIN
