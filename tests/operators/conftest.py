"""Imports that take seconds; rendered data that the tests of learning and training share."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="module", autouse=True)
def _late_imports(request: pytest.FixtureRequest) -> None:
    """Imports what a module of tests names under `if TYPE_CHECKING:` when its first test runs: torch takes seconds.

    Nothing of that is imported when tests are collected, and where an extra is not installed the tests are skipped.
    """
    file = request.path
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), file, "exec"), vars(request.module))


@pytest.fixture(scope="session")
def worlds(once: Callable[..., Path]) -> Path:
    """A data folder of one world to train on and one to score on, four images each."""
    from operators.training import simulated_worlds

    words = ["--worlds", "1", "--validation", "1", "--frames", "4"]
    return once("worlds", lambda folder: simulated_worlds.main([str(folder), *words]))
