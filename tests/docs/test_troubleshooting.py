"""The messages that docs/troubleshooting.md explains are those that the program prints."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from source_trees import nodes_of

GAP = "\0"
"""Stands for what a message puts in."""


def texts_of(repository: Path) -> Iterator[str]:
    """Every text of the program, with a gap for each value that is put in."""
    for package in ("dataflow", "operators"):
        for file in sorted((repository / package).rglob("*.py")):
            for node in nodes_of(file):
                if isinstance(node, ast.JoinedStr):
                    yield "".join(str(part.value) if isinstance(part, ast.Constant) else GAP for part in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value


def messages_of(page: str) -> list[str]:
    """The messages in the first column of the tables."""
    cells = re.findall(r"^\| (`[^|]*`) \|", page, re.MULTILINE)
    return [message for cell in cells for message in re.findall(r"`([^`]+)`", cell)]


def said(message: str, texts: str) -> bool:
    pieces = [piece.strip() for piece in message.split("…") if piece.strip()]
    return re.search(r"[^\n]{0,300}?".join(re.escape(piece) for piece in pieces), texts) is not None


@pytest.fixture(scope="module")
def texts(repository: Path) -> str:
    return "\n".join(text.replace("\n", " ") for text in texts_of(repository))


def test_every_message_is_one_of_the_program(repository: Path, texts: str) -> None:
    messages = messages_of((repository / "docs" / "troubleshooting.md").read_text(encoding="utf-8"))
    assert len(messages) > 40
    unknown = [message for message in messages if not said(message, texts)]
    assert not unknown, f"docs/troubleshooting.md explains what nobody says: {unknown}"


def test_quoted_message_absent_from_the_source_is_found(texts: str) -> None:
    assert said("no graph runs on this machine", texts)
    assert not said("the flux capacitor is empty", texts)
