"""Workers answer, or end in bounded time with the operator and the call that they were at; none is left over."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from dataflow.supervision.core.report import RunFailed, Status
from dataflow.verification.workers.processes import Call, call_workers

HERE = Path(__file__).resolve().parent


def call(name: str, **request: Any) -> Call:
    return Call(f"worker_functions:{name}", request, ("mix", "smooth"))


def gone(pid: int) -> bool:
    """Whether a process ends within some seconds."""
    try:
        psutil.Process(pid).wait(timeout=20)
    except psutil.NoSuchProcess:
        return True
    except psutil.TimeoutExpired:
        return False
    return True


def test_workers_get_their_requests_under_the_threads_of_the_graph_and_answer_in_order() -> None:
    answers = call_workers([call("describe", word=word) for word in ("one", "two")], threads=3)

    assert answers == [{"word": w, "OMP_NUM_THREADS": "3", "PYTHONHASHSEED": "0"} for w in ("one", "two")]


def test_exception_of_a_worker_ends_the_others() -> None:
    with pytest.raises(RunFailed, match="the wheels came off") as raised:
        call_workers([call("stall"), call("fail")], threads=1)

    assert "worker_functions.py" in raised.value.details


@pytest.mark.parametrize(
    ("code", "phase", "message"),
    [
        (-signal.SIGKILL, "fire", r"operator 'smooth' was killed by SIGKILL in firing 7 of smooth after 0"),
        (-signal.SIGSEGV, "setup", r"operator 'smooth' was killed by SIGSEGV in setup\(\)"),
        (7, "close", r"operator 'smooth' ended its process with code 7 in close\(\)"),
        pytest.param(0, "fire", r"operator 'smooth' ended its process with code 0 in firing 7", marks=pytest.mark.long),
    ],
)
def test_a_worker_that_dies_names_the_operator_and_its_call(code: int, phase: str, message: str) -> None:
    with pytest.raises(RunFailed, match=message) as raised:
        call_workers(
            [call("die", code=code, phase=phase)],
            threads=1,
            locate=lambda call, operator, repeated: f"firing 7 of {operator} after {repeated}",
        )

    assert raised.value.operator == "smooth"
    assert not raised.value.interrupted


@pytest.mark.long
def test_a_worker_without_progress_is_ended_and_its_last_words_are_shown() -> None:
    with pytest.raises(RunFailed, match=r"operator 'smooth' made no progress for 4 s in a firing") as raised:
        call_workers([call("stall")], threads=1, stall_timeout=4.0)

    assert "thinking" in raised.value.details


@pytest.mark.long
def test_child_processes_of_an_operator_end_with_its_worker(tmp_path: Path) -> None:
    note = tmp_path / "pid"

    with pytest.raises(RunFailed, match="was killed by SIGKILL"):
        call_workers([call("leave_children", note=str(note))], threads=1)

    assert gone(int(note.read_text()))


def test_an_interruption_ends_all_workers(tmp_path: Path) -> None:
    notes = [tmp_path / "one", tmp_path / "two"]
    asked = threading.Event()

    def interrupt(status: Status) -> None:
        if all(note.exists() and note.read_text() for note in notes) and not asked.is_set():
            asked.set()
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(RunFailed) as raised:
        call_workers([call("wait_for_ever", note=str(note)) for note in notes], threads=1, watch=interrupt)

    assert raised.value.interrupted
    assert all(gone(int(note.read_text())) for note in notes)


def test_workers_do_not_outlive_a_parent_that_is_killed(tmp_path: Path) -> None:
    note = tmp_path / "pid"
    script = (
        "import sys; from dataflow.verification.workers.processes import Call, call_workers; "
        "call_workers([Call('worker_functions:wait_for_ever', {'note': sys.argv[1]})], threads=1)"
    )
    path = os.pathsep.join([str(HERE), *filter(None, sys.path)])
    parent = subprocess.Popen([sys.executable, "-c", script, str(note)], env={**os.environ, "PYTHONPATH": path})
    deadline = time.monotonic() + 60
    while not (note.exists() and note.read_text()):
        assert time.monotonic() < deadline
        assert parent.poll() is None
        time.sleep(0.02)

    parent.kill()
    parent.wait()

    assert gone(int(note.read_text()))
