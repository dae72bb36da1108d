"""The reference page of the Python interface is what docstrings and signatures say."""

from __future__ import annotations

from pathlib import Path

import pytest
from api_page import SECTIONS, documentation, markdown, section, signature

import dataflow
import dataflow.operator
import dataflow.recording


def test_api_page_matches_the_docstrings(repository: Path) -> None:
    page = (repository / "docs" / "api.md").read_text(encoding="utf-8")

    assert page == markdown(), "run: python tools/api_page.py > docs/api.md"


def test_every_public_name_of_the_package_is_on_the_page() -> None:
    listed = {name for _, module, names in SECTIONS if module == "dataflow" for name in names}

    assert listed == set(dataflow.__all__)


def test_a_thing_without_a_docstring_is_found() -> None:
    def undocumented() -> None: ...

    with pytest.raises(ValueError, match="thing has no docstring"):
        documentation(undocumented, "my.thing")


def test_signatures_are_as_the_source_has_them() -> None:
    assert signature(dataflow.open) == "(path: str | Path) -> RecordedStreams"
    assert signature(dataflow.operator.In) == "(*, many: bool = False, doc: str = '')"
    assert "    tolerance: float | None = None,\n" in section("dataflow", "verify")
    assert ".between(start: float | None = None" in section("dataflow", "RecordedStream")
