"""Workers that were started before it was known what they would do."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from dataflow.process.polling import readable
from dataflow.supervision.core.report import RunFailed
from dataflow.verification.workers.prestart import EarlyWorkers, PrestartedWorker, early_workers
from dataflow.verification.workers.processes import Call, call_workers


@pytest.fixture
def early() -> Iterator[EarlyWorkers]:
    with early_workers(2) as workers:
        yield workers


def children() -> set[int]:
    return {process.pid for process in psutil.Process().children()}


def calls(*names: str, **request: object) -> list[Call]:
    return [Call(f"worker_functions:{name}", request, ("mix", "smooth")) for name in names]


def test_early_workers_answer_and_become_children_of_this_process(early: EarlyWorkers) -> None:
    answers = call_workers(calls("describe", "describe", "describe", word="w"), threads=1, early=early)

    assert answers == [{"word": "w", "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}] * 3


def test_early_workers_find_modules_of_folders_added_later(
    early: EarlyWorkers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "found_later.py").write_text("def found(request, board):\n    return request['x'] + 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    early.foresee(["found_later", "never_there"])

    assert call_workers([Call("found_later:found", {"x": 1})], threads=1, early=early) == [2]


def test_death_of_early_worker_is_reported(early: EarlyWorkers) -> None:
    with pytest.raises(RunFailed, match=r"operator 'smooth' ended its process with code 7 in close\(\)"):
        call_workers(calls("die", code=7, phase="close"), threads=1, early=early)
    with pytest.raises(RunFailed, match=r"operator 'smooth' was killed by SIGKILL"):
        call_workers(calls("die", code=-9, phase="setup"), threads=1, early=early)


def test_early_workers_that_are_not_taken_are_ended() -> None:
    before = children()
    for wait in (False, True):
        workers = EarlyWorkers(2)
        if wait:
            taken = workers.take(1)
            assert isinstance(taken, PrestartedWorker)
            assert taken.pid in children()
            taken.end()
        workers.close()
        assert children() == before


def test_single_early_worker_that_is_not_taken_is_ended() -> None:
    before = children()
    workers = EarlyWorkers(1)
    [worker] = workers._waiting
    assert readable([worker.channel], 60.0)

    workers.close()

    assert children() == before


def test_other_number_of_threads_gets_other_workers(early: EarlyWorkers) -> None:
    assert early.take(3) is None
    (answer,) = call_workers(calls("describe", word="w"), threads=3, early=early)

    assert answer["OMP_NUM_THREADS"] == "3"


def test_early_workers_that_fail_to_start_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    before = children()
    with monkeypatch.context() as patched:
        patched.setattr(sys, "executable", "/bin/false")
        workers = EarlyWorkers(2)
    try:
        assert call_workers(calls("describe", word="w"), threads=1, early=workers)[0]["word"] == "w"
    finally:
        workers.close()
    assert children() == before
