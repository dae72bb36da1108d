"""The docs site holds every page, under a place of its own, and fetches nothing."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ruamel.yaml import YAML


@pytest.fixture(scope="module")
def site() -> dict[str, Any]:
    file = Path(__file__).resolve().parents[2] / "docs" / "site" / "mkdocs.yml"
    loaded: dict[str, Any] = YAML(typ="safe").load(file.read_text(encoding="utf-8"))
    return loaded


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    file = Path(__file__).resolve().parents[2] / "docs" / "site" / "pages.py"
    spec = importlib.util.spec_from_file_location("pages", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def named(entry: Any) -> Iterator[str]:
    """The pages that an entry of the navigation names."""
    if isinstance(entry, str):
        yield entry
    else:
        for item in entry.values() if isinstance(entry, dict) else entry:
            yield from named(item)


def test_every_page_stands_in_the_navigation_once(site: dict[str, Any], hooks: ModuleType, repository: Path) -> None:
    own = [str(page.relative_to(repository)) for page in (repository / "docs").rglob("*.md")]
    pages = [hooks.place_of(file) for file in (*own, *hooks.pages())]
    listed = [*named(site["nav"]), *hooks.figures()]

    missing = sorted(set(pages) - set(listed))
    assert not missing, f"docs/site/mkdocs.yml: nav lacks {', '.join(missing)}"
    gone = sorted(set(listed) - set(pages))
    assert not gone, f"docs/site/mkdocs.yml: nav names pages that are not there: {', '.join(gone)}"
    assert len(listed) == len(set(listed))
    assert len(pages) == len(set(pages))


def test_the_site_fetches_nothing(site: dict[str, Any]) -> None:
    assert site["theme"]["font"] is False
    assert site["plugins"] == ["search"]
    assert not {"extra_css", "extra_javascript"} & set(site)


@pytest.mark.parametrize(
    ("file", "written", "fitted"),
    [
        ("docs/a.md", "[b](b.md#c)", "[b](b.md#c)"),
        ("docs/a.md", "[r](../README.md#figures)", "[r](overview.md#figures)"),
        ("docs/a.md", "[t](../tests/test_b.py)", "[t](files/tests/test_b.py)"),
        ("docs/a.md", "[n](notebooks/recording.ipynb)", "[n](notebooks/recording.md)"),
        ("docs/a.md", "[x](https://example.org/x.md) [y](#here)", "[x](https://example.org/x.md) [y](#here)"),
        ("docs/a.md", "```text\n[b](../README.md)\n```", "```text\n[b](../README.md)\n```"),
        ("README.md", "[d](docs/design.md)", "[d](design.md)"),
        ("benchmarks/peers/a.md", "[t](../t.md) [p](p.py)", "[t](../t.md) [p](../../files/benchmarks/peers/p.py)"),
        ("docs/a.md", "| `int \\| None` | \\| |", "| `int | None` | \\| |"),
        ("benchmarks/a.md", "[d](../docs/design.md#time)", "[d](../design.md#time)"),
    ],
)
def test_pages_fit_the_site(hooks: ModuleType, file: str, written: str, fitted: str) -> None:
    assert hooks.fitted(written, file) == fitted


def test_anchors_are_those_of_github(hooks: ModuleType) -> None:
    assert hooks.github_anchor("Well-known types: Foxglove protobuf") == "well-known-types-foxglove-protobuf"
    assert hooks.github_anchor("`a_b` & c") == "a_b--c"
