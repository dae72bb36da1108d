"""Docstrings of what others may use begin with a verb or their subject, not with a question word."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from source_trees import nodes_of

OPENS_WITH_A_QUESTION = re.compile(r"(What|How|Where|Which|Whether)\b")


def public_docstrings(path: Path) -> Iterator[tuple[int, str]]:
    """Yields line and first line of the docstrings of a module and of what it has that is public."""
    for node in nodes_of(path):
        if isinstance(node, ast.Module):
            line, name = 1, ""
        elif isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            line, name = node.lineno, node.name
        else:
            continue
        yield from attribute_docstrings(node)
        docstring = ast.get_docstring(node)
        if docstring and not (name.startswith("_") and not name.startswith("__")):
            yield line, docstring.splitlines()[0]


def attribute_docstrings(
    node: ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef,
) -> Iterator[tuple[int, str]]:
    """Yields line and first line of the texts that stand below assignments."""
    for before, after in pairwise(node.body):
        if isinstance(before, ast.Assign | ast.AnnAssign) and isinstance(after, ast.Expr):
            value = after.value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield after.lineno, value.value.splitlines()[0]


def test_no_public_docstring_opens_with_a_question_word(repository: Path) -> None:
    found = [
        f"{path.relative_to(repository)}:{line}: {first}"
        for package in ("dataflow", "operators", "tools")
        for path in sorted((repository / package).rglob("*.py"))
        for line, first in public_docstrings(path)
        if OPENS_WITH_A_QUESTION.match(first)
    ]
    assert not found, "\n".join(found)


WITHOUT_A_METHOD = {
    "CustomDetector", "DepthDecoder", "DepthSelfFilter",
    "DepthWatch", "ImageClassifier", "ImageDecoder", "ImageWatch", "MotionCheck", "OnnxDetector",
    "OnnxRigDetector", "OnnxSegmenter", "ScanWatch", "SceneGraphMetrics", "ScoreFilter", "Segmenter", "SelfFilter",
    "TorchvisionRigDetector", "TorchvisionRigSegmenter", "TrajectoryPlots", "VideoDecoder",
}  # fmt: skip
"""Operators that apply a definition or a network of any make, or what this project thought of itself."""


def test_every_other_operator_names_the_source_of_its_method(repository: Path) -> None:
    page = (repository / "docs" / "operators.md").read_text(encoding="utf-8")
    takes = dict(re.findall(r"^\| \[(\w+)\]\(#\w+\) \| (.*?) \|", page.split("\n## ", 1)[0], re.MULTILINE))
    sections = {part.split("\n", 1)[0]: part for part in re.split(r"^### ", page, flags=re.MULTILINE)[1:]}
    silent = {
        name for name, types in takes.items() if types and not re.search(r"\b(19|20)\d\d\b|REP \d", sections[name])
    }
    assert silent == WITHOUT_A_METHOD
