"""The kind of a run decides which parts are made; parts do not ask for it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from source_trees import nodes_of

PACKAGES = ("execution", "process", "reexecution", "supervision", "verification")
KINDS = {
    "LiveRunner",
    "OperatorRunner",
    "RecordedRunner",
    "LogFeed",
    "LosslessPolicy",
    "LossReportingPolicy",
    "LiveSinkProcess",
}
"""Classes of which one run has this and another that."""
MAKES = {"__init__", "_outlet", "open", "release", "_make_runner", "_make_source"} | {
    "core_of",
    "configurations",
    "_common",
    "_operators",
}
"""Functions that make the parts of a run, or of a process."""


def functions(repository: Path) -> Iterator[tuple[str, str, ast.AST]]:
    """Yields the file, the name and the code of every function and of every module."""
    for package in PACKAGES:
        for path in sorted((repository / "dataflow" / package).rglob("*.py")):
            for node in nodes_of(path):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    yield path.relative_to(repository).as_posix(), node.name, node


def test_no_function_checks_the_class_of_runners_or_feeds(repository: Path) -> None:
    asked = [
        f"{file}: {ast.unparse(call)}"
        for file, _, function in functions(repository)
        for call in ast.walk(function)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "isinstance"
        if KINDS & {name.id for name in ast.walk(call.args[1]) if isinstance(name, ast.Name)}
    ]
    assert not asked, "\n".join(asked)


def test_whether_a_run_is_live_is_asked_where_its_parts_are_made(repository: Path) -> None:
    asked = {
        f"{file}: {name}"
        for file, name, function in functions(repository)
        for read in ast.walk(function)
        if isinstance(read, ast.Attribute) and read.attr == "live"
        if ast.unparse(read.value).rpartition(".")[2].lstrip("_") in ("config", "plan")
    }
    assert asked
    assert not [place for place in asked if place.rpartition(" ")[2] not in MAKES], sorted(asked)
