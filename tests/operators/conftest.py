"""Rendered data that the tests of learning and training share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def worlds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder of one world to train on and one to score on, four images each."""
    from operators.training import simulated_worlds

    folder = tmp_path_factory.mktemp("data") / "worlds"
    simulated_worlds.main([str(folder), "--worlds", "1", "--validation", "1", "--frames", "4"])
    return folder
