"""Counts files, lines, floors and arrows of the rooms of a tree: `python tools/rooms.py [REVISION]`.

A room is a folder, its parts are modules and folders; an arrow leads from a part to one beside it that it imports, also
inside functions. A part imports nothing from its floor or above. `up` counts parts that are left when no floor can be
taken away: folders that import each other. `__init__` files gather names and do not count.
"""

from __future__ import annotations

import argparse
import ast
import io
import subprocess
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = ("dataflow", "operators")
PLACES = (*PRODUCT, "tests", "benchmarks", "tools", "docs")
LEAST = 12
"""Modules and folders in a room from which it is listed."""


def sources(revision: str | None) -> dict[str, str]:
    """Returns path → text of Python and Markdown files: of a revision, or of what git tracks in the working tree."""
    if revision is None:
        names = _git("ls-files", *PLACES).decode().splitlines()
        return {name: (ROOT / name).read_text(encoding="utf-8") for name in names if _counts(name)}
    with tarfile.open(fileobj=io.BytesIO(_git("archive", revision))) as archive:
        members = [each for each in archive if each.isfile() and _counts(each.name)]
        files = {each.name: archive.extractfile(each) for each in members}
        return {name: file.read().decode() for name, file in files.items() if file is not None}


def _counts(name: str) -> bool:
    return name.split("/")[0] in PLACES and name.endswith((".py", ".md"))


def _git(*words: str) -> bytes:
    return subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True).stdout


def arrows(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """Returns module → the modules that it imports, of Python texts by their paths."""
    modules = {".".join(PurePosixPath(path).with_suffix("").parts): text for path, text in texts.items()}
    modules = {name: text for name, text in modules.items() if not name.endswith(".__init__")}

    def found(name: str) -> str | None:
        while name and name not in modules:
            name = name.rpartition(".")[0]
        return name or None

    return {name: {each for word in imports(text) if (each := found(word))} - {name} for name, text in modules.items()}


def imports(text: str) -> Iterable[str]:
    """Yields the full names that a module imports."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def plan(room: str, between: Mapping[str, set[str]]) -> tuple[int, int, int, int]:
    """Returns how many modules and folders a room has, on how many floors, its arrows, and what imports each other."""
    left: dict[str, set[str]] = {}
    for module, others in between.items():
        if module.startswith(f"{room}."):
            beside = {_part(room, other) for other in others if other.startswith(f"{room}.")}
            left.setdefault(_part(room, module), set()).update(beside - {_part(room, module)})
    count, arrow, floors = len(left), sum(map(len, left.values())), 0
    while free := [name for name, others in left.items() if not others & left.keys()]:
        left = {name: others for name, others in left.items() if name not in free}
        floors += 1
    return count, floors, arrow, len(left)


def _part(room: str, module: str) -> str:
    return module.removeprefix(f"{room}.").partition(".")[0]


def report(texts: Mapping[str, str]) -> Iterable[str]:
    """Yields the lines of the report."""
    yield f"{'place':24}{'files':>8}{'lines':>10}"
    for place in PLACES:
        inside = [text for path, text in texts.items() if path.startswith(f"{place}/")]
        yield f"{place:24}{len(inside):8,}{sum(text.count(chr(10)) for text in inside):10,}"
    product = {path: text for path, text in texts.items() if path.split("/")[0] in PRODUCT and path.endswith(".py")}
    between = arrows(product)
    rooms = {".".join(name.split(".")[:depth]) for name in between for depth in range(1, name.count(".") + 1)}
    yield f"\n{'room':36}{'parts':>6}{'floors':>8}{'arrows':>8}{'up':>5}"
    for room in sorted(rooms):
        count, floors, arrow, up = plan(room, between)
        if count >= LEAST or up:
            yield f"{room:36}{count:6}{floors:8}{arrow:8}{up:5}"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", nargs="?", help="a commit; default: the working tree")
    print("\n".join(report(sources(parser.parse_args(words).revision))))


if __name__ == "__main__":
    main()
