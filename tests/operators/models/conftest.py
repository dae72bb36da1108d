"""A cache of models, and a server of one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from served_models import Served, serving


@pytest.fixture
def served() -> Iterator[Served]:
    with serving() as state:
        yield state


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache; proxies of this machine are not asked."""
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.upper(), raising=False)
    folder = tmp_path / "cache"
    monkeypatch.setenv("DATAFLOW_MODEL_CACHE", str(folder))
    return folder
