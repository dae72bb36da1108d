"""A bare `pytest` is divided among the cores: once."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest


def conftest() -> ModuleType:
    """The suite's hooks, as a module of this test's."""
    spec = importlib.util.spec_from_file_location("suite_conftest", Path(__file__).parent / "conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def begun(**facts: Any) -> SimpleNamespace:
    """The options of a run of these facts once it has begun."""
    option = SimpleNamespace(keyword="", usepdb=False, collectonly=False, numprocesses=None, dist="no", long=False)
    plugins = SimpleNamespace(hasplugin=lambda name: name == "xdist")
    config = SimpleNamespace(args_source=pytest.Config.ArgsSource.TESTPATHS, option=option, pluginmanager=plugins)
    config.__dict__.update(facts)
    conftest().pytest_cmdline_main(config)
    return option


def kept(*, long: bool) -> list[str]:
    """The markers of the tests that run, of a quick and of a long one."""
    items = [SimpleNamespace(name=name, get_closest_marker=name.__eq__) for name in ("quick", "long")]
    hook = SimpleNamespace(pytest_deselected=lambda items: None)
    conftest().pytest_collection_modifyitems(SimpleNamespace(option=SimpleNamespace(long=long), hook=hook), items)
    return [item.name for item in items]


NAMED = pytest.Config.ArgsSource.ARGS


def test_the_whole_suite_is_divided_but_not_by_its_workers() -> None:
    assert begun().numprocesses
    assert begun(workerinput={"workerid": "gw0"}).numprocesses is None
    assert begun(args_source=NAMED).numprocesses is None


def test_long_tests_are_left_out_of_the_whole_suite_alone() -> None:
    assert not begun().long
    assert begun(args_source=NAMED).long
    assert kept(long=False) == ["quick"]
    assert kept(long=True) == ["quick", "long"]
