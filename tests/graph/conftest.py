"""Makes `graph_operators` importable, as a user's own package of operators would be."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from dataflow.graph import search

sys.path.insert(0, str(Path(__file__).resolve().parent))


@pytest.fixture(autouse=True)
def _folders_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Takes back the folders that a test adds to the places where modules are sought."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(search, "FOLDERS", [])
