"""Fixtures of recordings for analysis."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import analysed
import pytest

import dataflow


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "made.mcap"
    analysed.write(file)
    return file


@pytest.fixture
def recording(path: Path) -> Iterator[dataflow.RecordedStreams]:
    with dataflow.open(path) as opened:
        yield opened
