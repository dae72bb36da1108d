"""Makes the test operators importable, here and in workers, and watches for processes that are left over."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from orphans import end_orphans

HERE = Path(__file__).resolve().parent
KEPT = HERE.parent / "recordings_of"
sys.path += [str(HERE), str(KEPT), str(HERE.parent / "runtime")]


@pytest.fixture(autouse=True)
def _no_orphans() -> Iterator[None]:
    """Fails a test after which a child process is left."""
    yield
    assert not end_orphans()


@pytest.fixture
def kept() -> Path:
    """A small recording of a run, whole and identical: see `recordings_of`."""
    return KEPT / "run.mcap"


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets verification call its workers' functions in this process: for tests of what they find."""
    from dataflow.verification import verify
    from dataflow.verification.workers import mail as letters
    from dataflow.verification.workers import processes
    from dataflow.verification.workers.board import Board

    def call(calls: Sequence[processes.Call], **options: Any) -> list[Any]:
        return [_called(one, letters) for one in calls]

    def _called(one: processes.Call, letters: Any) -> Any:
        module, _, name = one.function.partition(":")
        letter, shared = os.memfd_create("call"), os.memfd_create("board")
        board = Board(shared, one.operators)
        try:
            letters.write_letter(letter, one.request)
            answer = getattr(sys.modules[module], name)(letters.read_letter(letter), board)
            letters.write_letter(letter, {"value": answer})
            return letters.read_letter(letter)["value"]
        finally:
            board.close()
            os.close(letter)
            os.close(shared)

    monkeypatch.setattr(verify, "call_workers", call)
