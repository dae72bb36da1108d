"""A bare `pytest` is divided among the cores: once."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest


def divided(**facts: Any) -> int | None:
    """The number of workers that a run of these facts asks for."""
    spec = importlib.util.spec_from_file_location("suite_conftest", Path(__file__).parent / "conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    option = SimpleNamespace(keyword="", markexpr="", usepdb=False, collectonly=False, numprocesses=None, dist="no")
    plugins = SimpleNamespace(hasplugin=lambda name: name == "xdist")
    config = SimpleNamespace(args_source=pytest.Config.ArgsSource.TESTPATHS, option=option, pluginmanager=plugins)
    config.__dict__.update(facts)
    module.pytest_cmdline_main(config)
    return option.numprocesses


def test_the_whole_suite_is_divided_but_not_by_its_workers() -> None:
    assert divided()
    assert divided(workerinput={"workerid": "gw0"}) is None
    assert divided(args_source=pytest.Config.ArgsSource.ARGS) is None
