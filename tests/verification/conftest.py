"""Makes the test operators importable, here and in workers, and watches for processes that are left over."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

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
