"""Runs commands in this process, on small graphs of the runtime's test operators."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cli_commands import call

RUNTIME_TESTS = Path(__file__).resolve().parent.parent / "runtime"
sys.path.append(str(RUNTIME_TESTS))

SMALL = """\
graph: small
namespace: test
params: {count: 30, sleep: 0.0, at: -1}
operators:
  left: {use: "runtime_operators:Counter", params: {count: "${count}"}}
  smooth: {use: "runtime_operators:Smooth", inputs: {x: left/fast}, params: {sleep: "${sleep}"}}
  gripper: {use: "runtime_operators:Broken", inputs: {x: left/fast}, params: {at: "${at}"}}
  sum: {use: "runtime_operators:Sum", inputs: {x: smooth/mean}}
"""

Outcome = Any
Command = Callable[..., Outcome]


@pytest.fixture(scope="session", autouse=True)
def _registry_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("registry")))
        patch.setenv("PYTHONPATH", str(RUNTIME_TESTS))
        patch.delenv("DISPLAY", raising=False)
        patch.delenv("WAYLAND_DISPLAY", raising=False)
        patch.delenv("DATAFLOW_TRACEBACK", raising=False)
        yield


@pytest.fixture(scope="session")
def dataflow() -> Command:
    return call


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A graph file: source, filter, pass-through that can be made to fail, sink with figures."""
    path = tmp_path_factory.mktemp("graphs") / "small.yaml"
    path.write_text(SMALL)
    return path


@pytest.fixture(scope="session")
def recorded(dataflow: Command, small: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A recording of that graph, and the JSON report of the run that made it."""
    path = tmp_path_factory.mktemp("recorded") / "run.mcap"
    outcome = dataflow("run", small, "--record", path, "--one-process", "--json")
    return path, json.loads(outcome.stdout)
