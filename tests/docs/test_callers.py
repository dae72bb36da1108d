"""Nothing stands in the packages without a caller there; what only tests call is named here."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from source_trees import nodes_of

from dataflow.cli.support.debug_shell import Shell

FOR_TESTS = {
    "pid_of",  # a process of a run, to stop it
    "SPATIAL",  # the page about the simulator is held against it
    "visualizers",  # the message types that have one of their own
    "TO_PROCESSES",  # the page about faults is held against it
}
CALLED_BY_OTHERS = {
    "list_commands",  # Typer asks a group for the commands of its help
    "get_next",  # onnxruntime asks a calibration reader
    # click asks a group
    *(name for name in vars(Shell) if name.startswith("do_")),  # the prompt's base class looks them up
    "emptyline",
    "completenames",
    "on_playback_control_request",  # Foxglove's server tells its listener
    "on_subscribe",
    "on_unsubscribe",
    "do_GET",  # http.server asks its handler
    "log_message",
}


def definitions(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Yields the names of functions, classes and constants; those that a decorator hands on are called through it."""
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            handed_on = any(
                isinstance(each, ast.Call) and ast.unparse(each.func) != "dataclass" for each in node.decorator_list
            )
            if not re.fullmatch(r"_.*_", node.name) and not handed_on:  # Python and notebooks call those
                yield node.name
    module = nodes[0]
    assert isinstance(module, ast.Module)
    for node in module.body:
        if isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name) and target.id != "__all__")


def uses(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Yields every name that is read, as a name, an attribute, a keyword or a word of a short text."""
    for node in nodes:
        kind: type = type(node)  # quicker than patterns, for a million nodes
        if kind is ast.Name:
            if type(node.ctx) is ast.Load:
                yield node.id
        elif kind is ast.Attribute:
            yield node.attr
        elif kind is ast.keyword:
            if node.arg is not None:
                yield node.arg
        elif kind is ast.Constant and type(node.value) is str and len(node.value) < 60:
            yield from re.findall(r"\w+", node.value)


def test_everything_has_a_caller(repository: Path) -> None:
    trees = {
        path: nodes_of(path)
        for root in ("dataflow", "operators", "tools", "benchmarks")
        for path in sorted((repository / root).rglob("*.py"))
    }
    used = Counter(name for nodes in trees.values() for name in uses(nodes))
    for page in (
        *(repository / "graphs").rglob("*.yaml"),
        *repository.glob("docs/*.md"),
        repository / "pyproject.toml",
    ):
        used.update(re.findall(r"\w+", page.read_text()))
    idle = [
        f"{path.relative_to(repository)}: {name}"
        for path, nodes in trees.items()
        if path.relative_to(repository).parts[0] in ("dataflow", "operators")
        for name in definitions(nodes)
        if not used[name] and name not in FOR_TESTS | CALLED_BY_OTHERS
    ]
    assert not idle, "\n".join(idle)
