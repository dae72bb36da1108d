"""What the installed package imports is declared, and nothing of it is under the GPL or AGPL."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path

import licences as tool
import pytest
from source_trees import nodes_of

REPOSITORY = Path(__file__).resolve().parents[2]
OURS = ("dataflow", "operators")
DISTRIBUTIONS = cache(packages_distributions)


@pytest.fixture(scope="module")
def imported() -> frozenset[tuple[str, Path]]:
    """Every module of others that the installed package imports, also inside functions, and where."""
    return frozenset(imports())


def imports() -> Iterator[tuple[str, Path]]:
    for package in OURS:
        for file in sorted((REPOSITORY / package).rglob("*.py")):
            for node in nodes_of(file):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                names += dynamic(node)
                for name in names:
                    top = name.partition(".")[0]
                    if top not in OURS and top not in sys.stdlib_module_names and top != "__future__":
                        yield name, file.relative_to(REPOSITORY)


def dynamic(node: ast.AST) -> list[str]:
    """The module that `importlib.import_module("name")` imports."""
    if isinstance(node, ast.Call) and ast.unparse(node.func) in ("importlib.import_module", "import_module"):
        return [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
    return []


def packages_of(module: str) -> set[str]:
    """The installed distributions that a module may come from, by canonical name."""
    if module.startswith("google.protobuf"):
        return {"protobuf"}  # `google` is a namespace of many
    return {re.sub(r"[-_.]+", "-", d).lower() for d in DISTRIBUTIONS().get(module.partition(".")[0], ())}


def test_every_import_is_a_declared_dependency(imported: frozenset[tuple[str, Path]]) -> None:
    requirements = [text for part in (*tool.PARTS, *tool.UNLISTED) for text in tool.declared(part)]
    declared = {re.split(r"[^a-z0-9-]", tool.canonical(re.match(r"[\w.-]+", text)[0]))[0] for text in requirements}
    for module, file in sorted(imported):
        found = packages_of(module)
        if found:  # what is not installed here (an extra) cannot be looked up
            assert found & (declared | {"pydantic-core"}), f"{file} imports {module}, which {found} brings"


def test_nothing_imported_is_under_the_gpl(imported: frozenset[tuple[str, Path]]) -> None:
    modules = {module for module, _ in imported}
    assert {"numpy", "zenoh", "rerun"} <= {m.partition(".")[0] for m in modules}
    assert "evo" not in {m.partition(".")[0] for m in modules}
    roots = {name for module in modules for name in packages_of(module)}
    for name, found in tool.closure(sorted(roots)).items():
        if found is not None:
            words = tool.licence(found)
            assert not tool.COPYLEFT.search(words), f"{name} is under {words}"


def test_the_page_has_every_package_with_its_licence() -> None:
    page = (REPOSITORY / "docs" / "licences.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| ([\w-]+) \| ([^|]+) \| ", page, re.MULTILINE))
    for name, found in tool.closure([*tool.declared(), *tool.declared("all"), *tool.declared("sim")]).items():
        if found is not None:
            assert listed.get(name) == tool.licence(found), "run: python tools/licences.py > docs/licences.md"
    assert not any(tool.COPYLEFT.search(words) for words in listed.values())
    assert page.startswith(tool.PAGE)


@pytest.mark.parametrize(
    ("words", "copyleft"),
    [
        ("GNU General Public License v3 (GPLv3)", True),
        ("GPL-3.0-or-later", True),
        ("AGPL-3.0-only", True),
        ("GNU Affero General Public License v3", True),
        ("MIT AND GPL-2.0", True),
        ("LGPL-2.1-or-later", False),
        ("GNU Lesser General Public License v3 (LGPLv3)", False),
        ("Apache-2.0", False),
    ],
)
def test_gpl_is_distinguished_from_lgpl(words: str, copyleft: bool) -> None:
    assert bool(tool.COPYLEFT.search(words)) == copyleft


def test_evo_would_be_found() -> None:
    """The check is not blind: the one package under the GPL that the tests use is seen as such."""
    pytest.importorskip("evo", reason="evo (the [dev] extra) is not installed")
    found: Distribution = distribution("evo")
    assert tool.COPYLEFT.search(tool.licence(found))


def test_project_declares_its_licence() -> None:
    assert "Apache License" in (REPOSITORY / "LICENSE").read_text(encoding="utf-8")
    assert "the robot-dataflow authors" in (REPOSITORY / "NOTICE").read_text(encoding="utf-8")
    text = (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    assert 'license = "Apache-2.0"' in text
    assert 'license-files = ["LICENSE", "NOTICE"]' in text
