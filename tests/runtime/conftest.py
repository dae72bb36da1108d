"""Makes the test operators importable, here and in host processes, and watches for leftovers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from dataflow.graph import Graph, load_graph, load_text

HERE = Path(__file__).resolve().parent


@pytest.fixture(autouse=True)
def _operators_importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(HERE))


@pytest.fixture(autouse=True)
def _no_orphans() -> Iterator[None]:
    """Fails a test after which a child process is left."""
    yield
    left = [p for p in psutil.Process().children(recursive=True) if "dataflow.runtime" in " ".join(p.cmdline())]
    for process in left:
        process.kill()
    assert not left


@pytest.fixture()
def mixed() -> Graph:
    """Every kind of input; small."""
    return load_graph(HERE / "mixed.yaml")


def chain(*operators: str, count: int = 60, source: str = "") -> Graph:
    """left (a Counter) → operators given as YAML lines."""
    body = "\n".join(f"  {line}" for line in operators)
    text = f"""
graph: chain
namespace: test
operators:
  left:
    use: runtime_operators:Counter
    params: {{count: {count}{source}}}
{body}
"""
    return load_text(text)


