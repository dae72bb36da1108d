"""Recordings of the recording tests, made in sight."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from made_recordings import recorded


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """record(rows, name=..., static=..., **options): writes (stream, message) rows, and closes."""

    def make(rows: Iterable[tuple[str, Any]], *, name: str = "a.mcap", **options: Any) -> Path:
        return recorded(tmp_path / name, rows, **options)

    return make
