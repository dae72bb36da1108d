"""Which files of another machine may be used, and which code of it is another."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dataflow.machines import files

WEIGHTS = "models/net.bin"


def sent(folder: Path, content: bytes) -> str:
    """Puts a file where a run that sent it would, and returns its digest."""
    (folder / WEIGHTS).parent.mkdir(exist_ok=True)
    (folder / WEIGHTS).write_bytes(content)
    digest = files.digest_of(folder / WEIGHTS)
    files.note_sent(folder, WEIGHTS, digest)
    return digest


def test_copy_of_an_earlier_run_does_not_replace_a_missing_file(tmp_path: Path) -> None:
    digest = sent(tmp_path, b"old")
    parameters = [{"layers": [{"weights": WEIGHTS}], "rate": 30}]

    (wrong,) = files.left_over(parameters, {}, tmp_path)

    assert wrong.startswith(f"{WEIGHTS} is missing where the run is started")
    assert str(tmp_path / WEIGHTS) in wrong
    assert not files.left_over(parameters, {WEIGHTS: digest}, tmp_path)  # the run has it
    assert not files.left_over([{"weights": "other.bin"}], {}, tmp_path)  # it needs another


@pytest.mark.parametrize("own", [b"written there since", None])
def test_files_of_the_machine_itself_are_its_own(tmp_path: Path, own: bytes | None) -> None:
    sent(tmp_path, b"old")
    (tmp_path / WEIGHTS).unlink()
    if own is not None:  # such as a log that the operator writes
        (tmp_path / WEIGHTS).write_bytes(own)
    (tmp_path / "calibration.yaml").write_text("never sent")

    assert not files.left_over([{"weights": WEIGHTS, "calibration": "calibration.yaml"}], {}, tmp_path)


def test_a_torn_list_of_copies_is_none(tmp_path: Path) -> None:
    sent(tmp_path, b"old")
    (tmp_path / files.SENT).write_text('{"models')
    assert not files.left_over([{"weights": WEIGHTS}], {}, tmp_path)


def test_programs_are_compared_only_for_the_same_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    X86, ARM = b"\x3e\x00", b"\xb7\x00"
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "rig_of_programs.py").write_text('command = ("./edges",)\n')

    def code(processor: bytes, body: bytes) -> files.Digests:
        (tmp_path / "edges").write_bytes(b"\x7fELF" + bytes(14) + processor + body)
        sys.modules.pop("rig_of_programs", None)
        found = files.code_of(["rig_of_programs:Edges"])
        return {name: digest for name, digest in found.items() if not name.startswith("dataflow/")}

    here = code(X86, b"a")
    assert set(here) == {"rig_of_programs.py", "edges"}
    assert files.differences(here, code(X86, b"b")) == ["edges differs"]
    assert files.differences(here, code(ARM, b"b")) == []
    (tmp_path / "edges").write_text("#!/bin/sh\n")
    assert files.differences(here, files.code_of(["rig_of_programs:Edges"])) == ["edges differs"]


def test_code_is_compared_without_import_and_missing_modules_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "rig_parts").mkdir()
    for name in ("__init__.py", "gain.py"):
        (tmp_path / "rig_parts" / name).write_text("GAIN = 2\n")
    (tmp_path / "rig_in_parts.py").write_text("from rig_parts.gain import GAIN\n")
    there = files.code_of(["rig_in_parts:Scaled"])
    (tmp_path / "rig_parts" / "gain.py").unlink()

    here = files.code_of(["rig_in_parts:Scaled"])

    assert files.differences(there, here) == ["rig_parts/gain.py is missing"]
    assert "rig_in_parts" not in sys.modules


@pytest.mark.parametrize("named", ["w/net.txt", "./w/net.txt"])
def test_file_named_by_a_parameter_is_sent_though_a_module_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "w").mkdir()
    (tmp_path / "w" / "net.txt").write_text("2")
    (tmp_path / "w" / "edges").write_text("a program")
    (tmp_path / "rig_of_weights.py").write_text("weights = Param('w/net.txt')\ncommand = ('w/edges',)\n")
    used = ["rig_of_weights:Weights"]
    parameters = [{"weights": named, "script": "rig_of_weights.py", "note": ""}]

    code = files.code_of(used, files.texts_of(parameters))

    assert {name for name in code if not name.startswith("dataflow/")} == {"rig_of_weights.py", "w/edges"}
    assert files.files_of(parameters, tmp_path).keys() >= {named}
