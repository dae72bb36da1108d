"""Product and pages are free of the wording that the style avoids."""

from __future__ import annotations

from pathlib import Path

import pytest
import words as tool

REPOSITORY = Path(__file__).resolve().parents[2]


def test_nothing_is_found() -> None:
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
        ("a.yaml", "# Nobody waits.\nnote: it knows\nsays: `says`  # tell\n", 3),
        ("a.py", '"""Tells it."""\nx = "it knows nobody"  # somebody\nsays = 1\n', 4),
    ],
)
def test_wording_is_found_in_prose_alone(tmp_path: Path, name: str, text: str, number: int) -> None:
    (tmp_path / name).write_text(text)
    assert len(list(tool.findings(tmp_path / name))) == number
