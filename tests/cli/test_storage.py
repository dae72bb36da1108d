"""Options on how a recording is stored: names by time, parts, limits; nothing is replaced unasked."""

from __future__ import annotations

import re
import stat
from pathlib import Path

import pytest
import typer

from dataflow.cli.support.storage import RecordOptions, named, recording_file, splitting_of
from dataflow.recording.parts import Splitting


def test_a_name_with_the_time_is_never_used_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "dataflow.cli.support.storage.time.gmtime", lambda: (1970, 1, 1, 0, 0, 30, 3, 1, 0)
    )  # a dead battery
    path = tmp_path / "a_{time}.mcap"

    first = named(path)
    first.touch()
    second = named(path)
    second.with_stem(f"{second.stem}_000").touch()
    third = named(path)

    assert re.fullmatch(r"a_1970-01-01T000030Z\.mcap", first.name)
    assert len({first, second, third}) == 3
    assert named(tmp_path / "a.mcap") == tmp_path / "a.mcap"


def test_parts_that_are_there_are_replaced_only_when_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run_004.mcap").touch()
    split = Splitting(size=1000)

    with pytest.raises(typer.Exit):
        recording_file(tmp_path / "run.mcap", split, overwrite=False, option="--record")
    assert "replace its parts with --overwrite" in capsys.readouterr().err
    recording_file(tmp_path / "run.mcap", split, overwrite=True, option="--record")
    recording_file(tmp_path / "run.mcap", None, overwrite=False, option="--record")


def test_a_limit_of_the_disk_splits_by_a_tenth_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert splitting_of("10min", None, "20GB") == Splitting(2 * 10**9, 600 * 10**9)
    assert splitting_of(None, "5GB", "20GB") == Splitting(5 * 10**9, None)
    with pytest.raises(typer.Exit):
        splitting_of(None, "15GB", "20GB")
    assert "less than two files" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("split_every", "1s"),
        ("split_size", "1MB"),
        ("keep_disk", "1MB"),
        ("record_failure", "end"),
        ("compression", "lz4"),
    ],
)
def test_options_of_a_recording_need_one(name: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit):
        RecordOptions(**{name: value}).storage()
    assert f"--{name.replace('_', '-')} is of a recording" in capsys.readouterr().err


@pytest.mark.long
def test_a_run_is_split_kept_within_its_limit_and_private(dataflow, small: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    run = ("run", small, "--one-process", "-q", "--record", tmp_path / "out" / "{time}.mcap", "--split-every", "100ms")

    told = dataflow(*run)

    files = sorted((tmp_path / "out").iterdir())
    assert len(files) > 1
    assert f"{len(files)} files" in told.stdout
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    dataflow(*run, "--readable", "group")
    assert {stat.S_IMODE(f.stat().st_mode) for f in set((tmp_path / "out").iterdir()) - set(files)} == {0o640}
