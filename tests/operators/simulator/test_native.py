"""The error where Open3D is missing."""

from __future__ import annotations

import sys

import pytest

from operators.simulator.rendering.native import open3d


def test_missing_open3d_is_named_with_its_extra_and_where_that_brings_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    with pytest.raises(ImportError, match=r"'robot-dataflow\[sim\]', where .* python_version < \"3.12\"$"):
        open3d()
