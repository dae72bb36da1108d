"""Processes of Python: as forks where this one is warm, else as new interpreters."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest

import dataflow.process.start as starting
from dataflow.process.start import ForkedProcess, fork, start

SAYS = """
import os, sys

def run(words):
    os.write(int(words[0]), f"{os.environ.get('TOLD')} {os.getpgid(0) == os.getpid()}".encode())
    print("printed")
    return 7

if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    (tmp_path / "says_its_place.py").write_text(SAYS)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(starting, "threads", lambda: 1)  # those of the test's own runner wait
    return "says_its_place"


def started(module: str, variables: Mapping[str, str], tmp_path: Path) -> tuple[starting.Process, int, str, str]:
    reading, writing = os.pipe()
    with (tmp_path / "printed").open("wb") as out:
        process = start(module, [str(writing)], [writing], variables, output=out.fileno())
    os.close(writing)
    code = process.wait(timeout=30)
    with os.fdopen(reading) as words:
        return process, code, words.read(), (tmp_path / "printed").read_text()


@pytest.mark.parametrize("warm", [False, True])
def test_a_fork_is_what_a_new_interpreter_is(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, warm: bool
) -> None:
    monkeypatch.setattr(starting, "_warm", warm)
    variables = {**os.environ, "TOLD": "yes", "PYTHONPATH": str(tmp_path)}
    process, *found = started(module, variables, tmp_path)
    assert isinstance(process, ForkedProcess if warm else subprocess.Popen)
    assert found == [7, "yes True", "printed\n"]


def test_libraries_with_other_threads_need_a_new_interpreter(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(starting, "_warm", True)
    variables = {**os.environ, "OMP_NUM_THREADS": "3", "PYTHONPATH": str(tmp_path)}
    assert isinstance(started(module, variables, tmp_path)[0], subprocess.Popen)


def test_a_process_with_threads_is_not_forked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starting, "_warm", True)
    over = threading.Event()
    thread = threading.Thread(target=over.wait, args=(30.0,))
    thread.start()
    try:
        assert not starting._fits(os.environ, sys.executable)
    finally:
        over.set()
        thread.join()


def test_a_fork_inherits_no_descriptor_but_those_handed_to_it(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with (tmp_path / "out").open("wb") as out, (tmp_path / "out").open("rb") as kept:

        def call() -> int:
            print(sorted(int(name) for name in os.listdir("/proc/self/fd")))
            return 0

        pid = fork(call, (kept.fileno(),), os.environ, (out.fileno(), out.fileno()))
        assert ForkedProcess(pid).wait(timeout=30) == 0
    found = eval((tmp_path / "out").read_text())
    assert found[:3] == [0, 1, 2]
    assert kept_number(found) == 1


def kept_number(found: list[int]) -> int:
    """How many descriptors are open besides the standard streams and that of the list."""
    return len(found) - 4


def test_an_error_of_a_fork_is_printed_and_is_its_exit_code(tmp_path: Path) -> None:
    def call() -> int:
        raise ValueError("of the call")

    with (tmp_path / "out").open("wb") as out:
        child = ForkedProcess(fork(call, (), os.environ, (out.fileno(), out.fileno())))
        assert child.wait(timeout=30) == 1
    assert "ValueError: of the call" in (tmp_path / "out").read_text()


def test_a_fork_that_hangs_is_killed() -> None:
    child = ForkedProcess(fork(lambda: threading.Event().wait(60) or 0, (), os.environ, None))
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(timeout=0.0)
    assert child.poll() is None
    child.kill()
    assert child.wait(timeout=30) == -9
