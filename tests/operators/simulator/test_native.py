"""The error where Open3D is missing."""

from __future__ import annotations

import sys

import pytest

from operators.simulator.rendering.native import open3d


def test_missing_open3d_is_named_with_its_extra_and_where_it_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"'robot-dataflow\[sim\]', but not for aarch64"):
        open3d()
