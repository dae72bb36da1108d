"""Product and pages are free of the wording that the style avoids."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    """`tools/words.py`."""
    spec = importlib.util.spec_from_file_location("words", REPOSITORY / "tools" / "words.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_nothing_is_found(tool: ModuleType) -> None:
    files = tool.files_under([REPOSITORY / each for each in tool.DEFAULT])
    assert len(files) > 1000
    found = [
        f"{file.relative_to(REPOSITORY)}:{line}: {words}" for file in files for line, _, words in tool.findings(file)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("name", "text", "number"),
    [
        ("a.md", "Nobody waits.\n```\nnobody\n```\nIt `says` so.\n", 1),
        ("a.md", "A queue of its own. What is late is dropped.\n", 2),
        ("a.py", '"""Tells it."""\nx = "it knows nobody"  # somebody\nsays = 1\n', 3),
    ],
)
def test_wording_is_found_in_prose_alone(tool: ModuleType, tmp_path: Path, name: str, text: str, number: int) -> None:
    (tmp_path / name).write_text(text)
    assert len(list(tool.findings(tmp_path / name))) == number
