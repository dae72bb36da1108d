"""Helpers of the recording tests: small messages and recordings made in sight."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dataflow.messages import Pose
from dataflow.recording import RecordingWriter


def pose_at(stamp: int, x: float = 0.0) -> Pose:
    return Pose(stamp=stamp, frame="map", position=[x, 0.0, 0.0], orientation=[0.0, 0.0, 0.0, 1.0])


@pytest.fixture
def pose() -> Callable[..., Pose]:
    """pose(stamp, x=0.0)"""
    return pose_at


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """record(rows, name=..., static=..., **options): writes (stream, message) rows of poses, and closes."""

    def make(
        rows: Iterable[tuple[str, Any]], *, name: str = "a.mcap", static: Iterable[str] = (), **options: Any
    ) -> Path:
        rows = list(rows)
        path = tmp_path / name
        seqs: dict[str, int] = {}
        with RecordingWriter(path, metadata={}, overwrite=True, **options) as writer:
            for stream, message in dict(reversed(rows)).items():
                writer.add_stream(stream, type(message), static=stream in static)
            for stream, message in rows:
                seq = seqs[stream] = seqs.get(stream, -1) + 1
                writer.write(stream, message, seq=seq)
        return path

    return make


@pytest.fixture
def noise() -> Callable[..., Any]:
    """noise(seed, shape): uint8 pixels that do not compress."""
    return lambda seed, *shape: np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
