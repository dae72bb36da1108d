"""`dataflow mcp` where its package is not installed."""

from __future__ import annotations

import sys

import pytest


def test_a_missing_package_is_named_with_its_extra(dataflow, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "dataflow.tool_server.server", raising=False)
    for name in [name for name in sys.modules if name.partition(".")[0] == "mcp"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcp", None)

    told = dataflow("mcp", code=2)

    assert "pip install 'robot-dataflow[mcp]'" in " ".join(told.stderr.split())
