"""Imports go the way that docs/design.md says."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest


def allowed(repository: Path) -> dict[str, tuple[str, ...]]:
    """The design page's table: package → what it may import."""
    page = (repository / "docs" / "design.md").read_text(encoding="utf-8")
    table = page.split("| package | may import |\n| --- | --- |\n")[1].split("\n\n")[0]
    rows = [row.strip("| ").split(" | ") for row in table.splitlines()]
    return {package.strip("`"): tuple(re.findall(r"`([\w.]+)`", imports)) for package, imports in rows}


def imports_of(file: Path) -> Iterator[str]:
    """The modules that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
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


def test_every_package_is_in_the_table(repository: Path) -> None:
    named = allowed(repository)
    for path in (repository / "dataflow").iterdir():
        name = f"dataflow.{path.stem}"
        if path.stem not in ("__init__", "__pycache__") and (path.is_dir() or path.suffix == ".py"):
            assert name in named, f"{name} is not in the table of docs/design.md"


def test_the_table_has_no_circle(repository: Path) -> None:
    left = {package: {m for m in may if m != package} for package, may in allowed(repository).items()}
    while left:
        free = [package for package, may in left.items() if not any(inside(m, other) for m in may for other in left)]
        if not free:
            pytest.fail(f"these import each other: {', '.join(left)}")
        for package in free:
            del left[package]
