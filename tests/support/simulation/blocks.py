"""Graph files read block by block: operators of simulated graphs come again and again, and each is read once for every
line on which it stands."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager

from dataflow.graph.problems import Place, Problems
from dataflow.graph.yaml import document
from dataflow.graph.yaml.tree import Entry, Leaf, Table, Tree
from simulation.bindings import bound

OPERATORS = "operators"
_parse = document.parse


def by_blocks() -> AbstractContextManager[None]:
    """Has graph files read block by block."""
    return bound({("dataflow.graph.yaml.document", "parse"): parse})


def parse(text: str, file: str, problems: Problems, lines: Sequence[str] = ()) -> Tree | None:
    """Reads what `document.parse` reads, to which a text with a fault is left."""
    entries: dict[str, Entry] = {}
    for line, block in _blocks(text, 1, indent=0):
        head, _, rest = block.partition("\n")
        if head == f"{OPERATORS}:":
            place = Place(file, line, 1, len(OPERATORS))
            inner = [_read(each, at, file) for at, each in _blocks(rest, line + 1, indent=2)]
            found = Table({name: entry for table in inner if table for name, entry in table.entries.items()}, place)
            read = None if None in inner else Table({OPERATORS: Entry(Leaf(OPERATORS, place, OPERATORS), found)}, place)
        else:
            read = _read(block, line, file)
        if read is None or entries.keys() & read.entries.keys():
            return _parse(text, file, problems, lines)
        entries |= read.entries
    problems.texts[file] = lines or text.split("\n")
    return Table(entries, Place(file, 1, 1))


def _blocks(text: str, line: int, *, indent: int) -> Iterator[tuple[int, str]]:
    """Divides a text at the lines that are indented so; with the number of the first line of each."""
    for block in re.split(rf"(?m)^(?= {{{indent}}}\S)", text):
        if block.strip():
            yield line, block.rstrip("\n")
        line += block.count("\n")


@functools.lru_cache(maxsize=1 << 14)
def _read(block: str, line: int, file: str) -> Table | None:
    """A block that stands on a line, as a mapping; None where it is faulty or something else."""
    problems = Problems()
    tree = _parse("\n" * (line - 1) + block, file, problems)
    return tree if isinstance(tree, Table) and not problems.found else None
