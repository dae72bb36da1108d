"""Imports go the way that docs/design.md says."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

import pytest
from source_trees import nodes_of

MOST_ON_A_FLOOR = 25
MOST_IN_A_FOLDER = 25
MOST_ARROWS_IN_ODOMETRY = 40
MOST_LINES = 60


def allowed(repository: Path) -> dict[str, tuple[str, ...]]:
    """The design page's table: package → what it may import."""
    page = (repository / "docs" / "design.md").read_text(encoding="utf-8")
    table = page.split("| package | may import |\n| --- | --- |\n")[1].split("\n\n")[0]
    rows = [row.strip("| ").split(" | ") for row in table.splitlines()]
    return {package.strip("`"): tuple(re.findall(r"`([\w.]+)`", imports)) for package, imports in rows}


def imports_of(file: Path) -> Iterator[str]:
    """The modules that a file imports, also inside functions."""
    for node in nodes_of(file):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: imports are absolute"
            yield node.module or ""


def inside(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def files_of(repository: Path, package: str) -> list[Path]:
    path = repository / package.replace(".", "/")
    return sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def test_imports_go_one_way(repository: Path) -> None:
    for package, may in allowed(repository).items():
        for file in files_of(repository, package):
            for module in imports_of(file):
                if inside(module, "dataflow") or inside(module, "operators"):
                    fits = any(inside(module, other) for other in (package, *may))
                    assert fits, f"{file.relative_to(repository)} imports {module}; {package} may import {may}"


def test_every_package_is_in_the_table_and_the_list_of_folders(repository: Path) -> None:
    named = allowed(repository)
    listed = (repository / "docs" / "design.md").read_text(encoding="utf-8").partition("\ndataflow/ ")[2]
    for path in (repository / "dataflow").iterdir():
        name = f"dataflow.{path.stem}"
        if path.stem not in ("__init__", "__pycache__") and (path.is_dir() or path.suffix == ".py"):
            assert name in named, f"{name} is not in the table of docs/design.md"
            here = f"\n  {path.name}{'/' if path.is_dir() else ''} "
            assert here in listed, f"{path.name} is not in the list of folders of docs/design.md"


def test_the_table_has_no_circle(repository: Path) -> None:
    left = {package: {m for m in may if m != package} for package, may in allowed(repository).items()}
    while left:
        free = [package for package, may in left.items() if not any(inside(m, other) for m in may for other in left)]
        if not free:
            pytest.fail(f"these import each other: {', '.join(left)}")
        for package in free:
            del left[package]


def module_of(file: Path, repository: Path) -> str:
    return ".".join(file.relative_to(repository).with_suffix("").parts).removesuffix(".__init__")


def names_imported(file: Path) -> Iterator[str]:
    """What a file imports, also inside functions and for annotations alone; names too, since they may be modules."""
    for node in nodes_of(file):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


@cache
def arrows(repository: Path) -> dict[str, set[str]]:
    """Module → the modules whose files it imports. Packages that only gather names of their modules do not count."""
    files = [file for package in ("dataflow", "operators") for file in (repository / package).rglob("*.py")]
    modules = {module_of(file, repository): file for file in files if file.name != "__init__.py"}

    def found(name: str) -> str | None:
        return name if name in modules else found(name.rpartition(".")[0]) if "." in name else None

    return {
        module: {other for name in names_imported(file) if (other := found(name)) is not None and other != module}
        for module, file in modules.items()
    }


def test_no_modules_import_each_other(repository: Path) -> None:
    left = dict(arrows(repository))
    while free := [module for module, others in left.items() if not others & left.keys()]:
        for module in free:
            del left[module]
    circle = {module: sorted(others & left.keys()) for module, others in left.items()}
    assert not circle, f"these import each other, or what does: {circle}"


def test_folders_of_operators_do_not_import_each_other_in_a_circle(repository: Path) -> None:
    left: dict[str, set[str]] = {}
    for file in (repository / "operators").rglob("*.py"):
        own = module_of(file, repository).split(".")[1:2]
        others = {name.split(".")[1] for name in names_imported(file) if inside(name, "operators") and "." in name}
        for room in own:
            left.setdefault(room, set()).update(others - {room})
    while free := [room for room, others in left.items() if not others & left.keys()]:
        for room in free:
            del left[room]
    circle = {room: sorted(others & left.keys()) for room, others in left.items()}
    assert not circle, f"these import each other, or what does: {circle}"


def inside_of(room: str, between: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Module or folder of a room → those beside it that it imports."""

    def part(module: str) -> str:
        return module.removeprefix(f"{room}.").partition(".")[0]

    parts: dict[str, set[str]] = {}
    for module, others in between.items():
        if module.startswith(f"{room}."):
            beside = {part(other) for other in others if other.startswith(f"{room}.")}
            parts.setdefault(part(module), set()).update(beside - {part(module)})
    return parts


def test_no_room_is_a_warehouse(repository: Path) -> None:
    between = arrows(repository)
    rooms = {".".join(module.split(".")[:depth]) for module in between for depth in range(1, module.count(".") + 1)}
    for room in sorted(rooms):
        left = inside_of(room, between)
        while left:
            floor = {name for name, others in left.items() if not others & left.keys()}
            assert len(floor) <= MOST_ON_A_FLOOR, f"{room}: {len(floor)} on one floor: {sorted(floor)}"
            assert floor, f"{room}: these import each other, by modules that do not: {sorted(left)}"
            left = {name: others for name, others in left.items() if name not in floor}
    odometry = sum(len(others) for others in inside_of("operators.odometry", between).values())
    assert odometry <= MOST_ARROWS_IN_ODOMETRY


def test_no_folder_has_more_files_than_one_looks_through(repository: Path) -> None:
    files = Counter(file.parent for package in ("dataflow", "operators") for file in files_of(repository, package))
    full = {str(folder.relative_to(repository)): count for folder, count in files.items() if count > MOST_IN_A_FOLDER}
    assert not full, f"folders of more than {MOST_IN_A_FOLDER} files; cut them by idea: {full}"


def lines_of_functions(tree: ast.AST, name: str) -> Iterator[tuple[str, int]]:
    """Every function below a node, nested ones and methods included, with its lines without decorators."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inner = f"{name}{'.' if name[-1] != ':' else ''}{node.name}"
            if not isinstance(node, ast.ClassDef):
                assert node.end_lineno is not None
                yield inner, node.end_lineno - node.lineno + 1
            yield from lines_of_functions(node, inner)
        else:
            yield from lines_of_functions(node, name)


def test_functions_are_short(repository: Path) -> None:
    long = {
        function: lines
        for package in ("dataflow", "operators")
        for file in files_of(repository, package)
        for function, lines in lines_of_functions(nodes_of(file)[0], f"{module_of(file, repository)}:")
        if lines > MOST_LINES
    }
    assert not long, f"functions of more than {MOST_LINES} lines: {long}"


def test_collecting_tests_imports_no_library_that_takes_seconds(imported_by_collection: set[str]) -> None:
    assert not imported_by_collection, "import it under `if TYPE_CHECKING:` (tests/conftest.py) or in the test"
