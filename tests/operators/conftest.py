"""Rendered data that the tests of learning and training share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def worlds(once: Callable[..., Path]) -> Path:
    """A data folder of one world to train on and one to score on, four images each."""
    from operators.training import simulated_worlds

    words = ["--worlds", "1", "--validation", "1", "--frames", "4"]
    return once("worlds", lambda folder: simulated_worlds.main([str(folder), *words]))
