"""Makes the test operator importable, here and in processes, and watches for leftovers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from orphans import end_orphans

sys.path.append(str(Path(__file__).resolve().parent))


@pytest.fixture(autouse=True)
def _no_orphans() -> Iterator[None]:
    """Fails a test after which a child process is left."""
    yield
    assert not end_orphans()
