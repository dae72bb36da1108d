"""Warm workers of a sweep: each call is a process alone, whatever becomes of it or of the one that forked it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread

import psutil
import pytest

from dataflow.sweep.warm import KILLED, Worker

THREAD = """
import threading
print("imported")
threading.Thread(target=threading.Event().wait, daemon=True).start()
class Operator: pass
"""
STORE = """
import time
class core:
    url_to_fs = staticmethod(lambda url: time.sleep(120))
"""
LATE = """
import os
import time
from dataflow.parent import end_with_parent
parent = os.getpid()
if os.fork() == 0:
    while os.getppid() == parent:
        time.sleep(0.001)
    end_with_parent(parent=parent)
    print("goes on")
"""


@pytest.fixture
def worker() -> Iterator[Worker]:
    made = Worker(())  # no command: what it calls loads by itself
    yield made
    made.close()


@pytest.fixture
def output(tmp_path: Path) -> tuple[Path, Path]:
    return tmp_path / "out", tmp_path / "err"


def warm(worker: Worker) -> int:
    assert worker._process is not None
    return worker._process.pid


def test_calls_are_forks_of_one_process(worker: Worker, output: tuple[Path, Path]) -> None:
    assert worker.call("command", ["--version"], (), output, 60) == 0
    first = warm(worker)
    assert output[0].read_text().startswith("dataflow ")
    assert worker.call("command", ["unknown"], (), output, 60) == 2
    assert "unknown" in output[1].read_text()
    assert warm(worker) == first


def test_module_starting_a_thread_at_import_is_not_preloaded(
    worker: Worker,
    output: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "starts_a_thread.py").write_text(THREAD)
    monkeypatch.syspath_prepend(str(tmp_path))
    uses = ("starts_a_thread:Operator", "not_there:Operator")
    assert worker.call("command", ["--version"], uses, output, 60) == 0
    first = warm(worker)
    assert worker.call("command", ["--version"], uses, output, 60) == 0
    assert warm(worker) == first
    assert capfd.readouterr() == ("", "imported\n")


@pytest.fixture
def waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words of a fetch that waits for its store."""
    (tmp_path / "fsspec.py").write_text(STORE)
    monkeypatch.syspath_prepend(str(tmp_path))
    return ["store://recording", "here"]


def test_a_call_that_takes_too_long_is_ended_and_the_next_one_made(
    worker: Worker, output: tuple[Path, Path], waits: list[str]
) -> None:
    assert worker.call("command", ["--version"], (), output, 60) == 0
    assert worker.call("fetch", waits, (), output, 0.3) is None
    assert psutil.Process(warm(worker)).children() == []
    assert worker.call("command", ["--version"], (), output, 60) == 0


@pytest.mark.parametrize("which", ["call", "warm process"])
def test_killed_process_is_reported_and_next_call_made(
    worker: Worker, output: tuple[Path, Path], waits: list[str], which: str
) -> None:
    assert worker.call("command", ["--version"], (), output, 60) == 0
    found: list[int | None] = []
    stop = Event()
    thread = Thread(target=lambda: found.append(worker.call("fetch", waits, (), output, 60, stop)))
    thread.start()
    try:
        forked = psutil.Process(warm(worker))
        while not (children := forked.children()):
            assert thread.is_alive()
        os.kill(children[0].pid if which == "call" else forked.pid, signal.SIGKILL)
        thread.join(30)
        assert found == [KILLED]
        assert psutil.wait_procs(children, timeout=30)[1] == []
    finally:
        stop.set()
        thread.join(30)
    assert worker.call("command", ["--version"], (), output, 60) == 0


def test_a_process_whose_parent_has_ended_before_it_asks_ends_at_once() -> None:
    ran = subprocess.run([sys.executable, "-c", LATE], capture_output=True, text=True, timeout=30, check=True)
    assert ran.stdout == ""
