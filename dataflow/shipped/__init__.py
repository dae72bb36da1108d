"""Finds the graphs and the recording that come with dataflow: inside the installed package, or in its checkout.

They lie at the top of the repository; `setup.py` copies them beside this file when a wheel is built.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

_HERE = Path(__file__).resolve().parent
_GRAPH = re.compile(r"^graph:", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class ShippedGraph:
    """A graph file that comes with dataflow. `name` has no suffix; `about` is the comment at its top, one line each."""

    name: str
    path: Path
    about: tuple[str, ...]


def folder(name: str) -> Path:
    """The folder `graphs` or `recordings`."""
    packaged = _HERE / name
    return packaged if packaged.is_dir() else _HERE.parents[1] / name


def graphs() -> tuple[ShippedGraph, ...]:
    """The graphs, those in subfolders last. Empty where the package was installed without them."""
    root = folder("graphs")
    files = sorted(root.rglob("*.yaml"), key=lambda file: (len(file.parts), file))
    texts = {file: file.read_text(encoding="utf-8") for file in files}
    return tuple(
        ShippedGraph(file.relative_to(root).with_suffix("").as_posix(), file, _comment(text))
        for file, text in texts.items()
        if _GRAPH.search(text)
    )


def graph(name: str) -> ShippedGraph | None:
    """The graph of that name, with or without `.yaml`."""
    return next((found for found in graphs() if name in (found.name, f"{found.name}.yaml")), None)


def recording(name: str) -> Path | None:
    """The recording of that name, with or without `.mcap`."""
    file = folder("recordings") / f"{name.removesuffix('.mcap')}.mcap"
    return file if Path(name).name == name and file.is_file() else None


def _comment(text: str) -> tuple[str, ...]:
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.removeprefix("#").strip())
    return tuple(lines)
