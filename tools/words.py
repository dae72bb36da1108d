"""Lists wording that the style of this project avoids, in docstrings, messages, comments, pages and YAML files.

Run `python tools/words.py [PATH ...]`; without paths it reads product and pages. It ends with 1 if it finds any.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEFAULT = ("dataflow", "operators", "graphs", "docs", "benchmarks", "README.md")
GENERATED = ("docs/api.md", "docs/messages.md", "docs/operators.md")
"""Pages that hold the docstrings again."""

PATTERNS = {
    "a person for a process or caller": re.compile(r"\b(?:some|no|any)body\b|\bwhoever\b", re.I),
    "of its own": re.compile(r"\bof (?:its|their|one's|your) own\b", re.I),
    "a function that speaks or thinks": re.compile(r"\b(?:tells|says|hears|knows)\b", re.I),
    "cleft sentence": re.compile(
        r"(?:^|[.:;] )What (?:[^.?`]|`[^`]*`)*\b(?:is|are|was|were)\b(?:[^.?`]|`[^`]*`)*\.", re.M
    ),
}
HINT = re.compile(r"(?i:some|no|any)body\b|(?i:whoever)|\b(?i:own)\b|\b(?i:tells|says|hears|knows)\b|What ")
"""Occurs in every file in which a pattern matches: a file without it is not taken apart."""


def texts_of(file: Path) -> Iterator[tuple[int, str]]:
    """Yields the line number and the text of each piece of prose in a Python, Markdown or YAML file."""
    source = file.read_text(encoding="utf-8")
    if not HINT.search(source):
        return
    if file.suffix == ".py":
        yield from python_prose(source)
    else:
        yield from page_prose(source)


def python_prose(source: str) -> Iterator[tuple[int, str]]:
    """Yields string constants that contain a space (docstrings and messages) and comments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value
    if not any("#" in line and HINT.search(line) for line in source.splitlines()):
        return
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def page_prose(source: str) -> Iterator[tuple[int, str]]:
    """Yields the lines of a page or YAML file outside of code blocks, without inline code and link targets."""
    inside = False
    for number, line in enumerate(source.splitlines(), 1):
        if line.lstrip().startswith("```"):
            inside = not inside
        elif not inside:
            yield number, re.sub(r"`[^`]*`|\]\([^)]*\)", "", line)


def findings(file: Path) -> Iterator[tuple[int, str, str]]:
    """Yields the line number, the name of the pattern and the words that match, for every match in a file."""
    for number, text in texts_of(file):
        for name, pattern in PATTERNS.items():
            for match in pattern.finditer(text):
                yield number + text.count("\n", 0, match.start()), name, " ".join(match[0].split())


def files_under(paths: list[Path]) -> list[Path]:
    """Returns the Python, Markdown and YAML files at or below the paths, sorted, without generated pages."""
    found = {path for root in paths for path in ([root] if root.is_file() else root.rglob("*"))}
    generated = {ROOT / page for page in GENERATED}
    return sorted(path for path in found if path.suffix in (".py", ".md", ".yaml") and path.resolve() not in generated)


def main() -> int:
    """Prints the findings, with their number at the end; returns 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path, default=[ROOT / each for each in DEFAULT])
    count = 0
    for file in files_under(parser.parse_args().paths):
        for number, name, words in sorted(findings(file)):
            print(f"{file}:{number}: {name}: {words[:100]}")
            count += 1
    print(f"{count} findings")
    return 1 if count else 0


if __name__ == "__main__":
    raise SystemExit(main())
