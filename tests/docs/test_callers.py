"""Nothing stands in the packages without a caller there; what only tests call is named here."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

FOR_TESTS = {
    "pid_of",  # a process of a run, to stop it
    "slerp",  # for operators to come, held against scipy
    "SPATIAL",  # the page about the simulator is held against it
    "TO_PROCESSES",  # the page about faults is held against it
}
CALLED_BY_OTHERS = {"get_next"}  # onnxruntime asks a calibration reader


def definitions(tree: ast.Module) -> Iterator[str]:
    """Yields the names of functions, classes and constants; those that a decorator hands on are called through it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            handed_on = any(
                isinstance(each, ast.Call) and ast.unparse(each.func) != "dataclass" for each in node.decorator_list
            )
            if not re.fullmatch(r"_.*_", node.name) and not handed_on:  # Python and notebooks call those
                yield node.name
    for node in tree.body:
        if isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name) and target.id != "__all__")


def uses(tree: ast.Module) -> Iterator[str]:
    """Yields every name that is read, as a name, an attribute, a keyword or a word of a short text."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Load()) | ast.Attribute(attr=name) | ast.keyword(arg=str(name)):
                yield name
            case ast.Constant(value=str(text)) if len(text) < 60:
                yield from re.findall(r"\w+", text)


def test_everything_has_a_caller(repository: Path) -> None:
    trees = {
        path: ast.parse(path.read_text())
        for root in ("dataflow", "operators", "tools", "benchmarks")
        for path in sorted((repository / root).rglob("*.py"))
    }
    used = Counter(name for tree in trees.values() for name in uses(tree))
    for page in (*repository.rglob("graphs/**/*.yaml"), *repository.glob("docs/*.md"), repository / "pyproject.toml"):
        used.update(re.findall(r"\w+", page.read_text()))
    idle = [
        f"{path.relative_to(repository)}: {name}"
        for path, tree in trees.items()
        if path.relative_to(repository).parts[0] in ("dataflow", "operators")
        for name in definitions(tree)
        if not used[name] and name not in FOR_TESTS | CALLED_BY_OTHERS
    ]
    assert not idle, "\n".join(idle)
