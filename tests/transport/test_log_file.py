"""Tools read the log of a running graph: what is there and what comes, also when a file is full."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dataflow.recording.streams.logs import LogLine
from dataflow.transport import log_file
from dataflow.transport.log_file import LogFile, LogFollower
from dataflow.transport.registry import registry_folder


@pytest.fixture(autouse=True)
def _folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def texts(follower: LogFollower) -> list[str]:
    return [line["text"] for line in follower.lines()]


def test_follower_reads_existing_lines_then_new_ones() -> None:
    log, follower = LogFile(), LogFollower(os.getpid())
    assert texts(follower) == []
    log.add(LogLine("info", "one"))
    assert texts(follower) == ["one"]
    assert texts(follower) == []
    log.add(LogLine("info", "two"))
    assert texts(follower) == ["two"]
    log.close()
    follower.close()


def test_a_full_file_becomes_the_older_one_and_nothing_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_file, "LONGEST", 100)
    log, follower = LogFile(), LogFollower(os.getpid())
    seen = []
    for k in range(50):
        log.add(LogLine("info", str(k)))
        if k % 2:
            seen += texts(follower)
    assert seen == [str(k) for k in range(50)]
    late = LogFollower(os.getpid())
    assert texts(late)[-1] == "49"
    assert sum(file.stat().st_size for file in registry_folder().iterdir()) < 500
    log.close()
    follower.close()
    late.close()


def test_it_is_for_this_user_alone_and_is_removed_at_the_end() -> None:
    log = LogFile()
    log.add(LogLine("info", "secret"))
    (file,) = registry_folder().iterdir()
    assert file.stat().st_mode & 0o777 == 0o600
    log.close()
    assert list(registry_folder().iterdir()) == []
    log.add(LogLine("info", "too late"))
    assert list(registry_folder().iterdir()) == []


def test_a_folder_that_refuses_ends_the_log_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "file"))
    log = LogFile()
    log.add(LogLine("info", "x"))
    log.close()


def test_a_line_that_is_half_written_is_read_when_it_is_whole(tmp_path: Path) -> None:
    path = registry_folder() / f"{os.getpid()}-1.log"
    follower = LogFollower(os.getpid())
    path.write_text('{"text": "a"}\n{"te')
    assert texts(follower) == ["a"]
    with path.open("a") as file:
        file.write('xt": "b"}\nnonsense\n')
    assert texts(follower) == ["b"]
    follower.close()
