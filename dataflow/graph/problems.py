"""Problems of a graph, reported as a compiler does: place, message, the line with a caret, the nearest right word."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

from rich.cells import cell_len

from dataflow.extras import INSTALL

MAX_PROBLEMS = 100
"""Faults that are reported at most; the rest of the graph is not read."""
MAX_MESSAGE = 2_000
"""Characters of a message or a hint; its middle is left out beyond that."""
SHOWN_WIDTH = 160
"""Characters of a source line that are shown."""
MAX_CHOICES = 2_000
"""Words that a wrong one is compared with."""
MAX_WORD = 200
"""Characters of a word that is compared."""
SETTINGS = "--set"
"""The file that the `--set` words of the command line are the lines of."""
LISTED = 50
"""Words that are listed where none is near."""


@dataclass(frozen=True, slots=True, order=True)
class Place:
    """A span of one source line: 1-based line and column, width in characters.

    `given`: where a value was given that stands here because of a `${}`.
    """

    file: str
    line: int
    column: int
    width: int = 1
    given: Place | None = field(default=None, compare=False, repr=False)

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"


@dataclass(frozen=True, slots=True)
class Problem:
    """One fault of a graph: where, what, and (`hint`) what would be right.

    `source` is the text of the line; `related` holds further places that matter, each with a word about it.
    """

    file: str
    line: int
    column: int
    message: str
    hint: str = ""
    source: str = ""
    width: int = 1
    related: tuple[tuple[Place, str], ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.file}:{self.line}:{self.column}: {self.message}"]
        if self.source.strip():
            shown, column = _window(self.source.replace("\t", " "), self.column)
            number = f"{self.line:>5}"
            indent = " " * cell_len(shown[: column - 1])
            caret = "^" * max(1, cell_len(shown[column - 1 : column - 1 + self.width]))
            lines += [f"{number} | {shown}", f"{' ' * len(number)} | {indent}{caret}"]
        lines += [f"      {place}: {word}" for place, word in self.related]
        lines += [f"      {line}" for line in self.hint.splitlines()]
        return "\n".join(lines)

    @property
    def place(self) -> Place:
        return Place(self.file, self.line, self.column, self.width)

    def to_json(self) -> dict[str, Any]:
        return {
            "file": self.file,
            "line": self.line,
            "column": self.column,
            "message": self.message,
            "hint": self.hint,
            "related": [
                {"file": place.file, "line": place.line, "column": place.column, "message": word}
                for place, word in self.related
            ],
        }


class GraphError(ValueError):
    """A graph that cannot run; `problems` holds everything that is wrong with it, in file order."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(_texts(self.problems)))


def _texts(problems: Sequence[Problem]) -> list[str]:
    """Returns the problems as text; of those that installing one extra mends, the first and how many there are."""
    texts, more = [], dict[str, int]()
    for problem in problems:
        if problem.hint in more:
            more[problem.hint] += 1
            continue
        texts.append(str(problem))
        if problem.hint.startswith(INSTALL):
            more[problem.hint] = 0
    return texts + [f"      and {count} more: {hint}" for hint, count in more.items() if count]


@dataclass(slots=True)
class Problems:
    """Collects faults while a graph is read, so that all of them are reported together."""

    texts: dict[str, Sequence[str]] = field(default_factory=dict)
    """Shown file name → its lines."""
    found: list[Problem] = field(default_factory=list)

    def add(self, place: Place, message: str, hint: str = "", related: Iterable[tuple[Place, str]] = ()) -> None:
        """Adds a fault at a place; that of a value which `--set` has given is there, whatever stands for it."""
        if place.given is not None and place.given.file == SETTINGS:
            place, related = place.given, [(place, "stands for it here"), *related]
        elif place.given is not None:
            related = [(place.given, "given here"), *related]
        lines = self.texts.get(place.file, ())
        source = lines[place.line - 1] if 0 < place.line <= len(lines) else ""
        where = (place.file, place.line, place.column)
        problem = Problem(*where, _clipped(message), _clipped(hint), source, place.width, tuple(related))
        if problem in self.found:
            return
        self.found.append(problem)
        if len(self.found) == MAX_PROBLEMS:
            self.stop(place, f"{MAX_PROBLEMS} faults so far; the rest of the graph is not read")

    def stop(self, place: Place, message: str, hint: str = "") -> NoReturn:
        """Ends the loading here, with this fault and those found before. Raises `GraphError`."""
        if len(self.found) < MAX_PROBLEMS - 1:
            self.add(place, message, hint)
        else:
            self.found.append(Problem(place.file, place.line, place.column, message, hint))
        self.check()
        raise AssertionError("a graph with a fault passes")

    def check(self) -> None:
        """Raises `GraphError` when anything was found."""
        if self.found:
            order = {file: index for index, file in enumerate(self.texts)}
            raise GraphError(sorted(self.found, key=lambda p: (order.get(p.file, len(order)), p.line, p.column)))


def _clipped(text: str) -> str:
    """`text`, or its beginning and end."""
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE // 2]} … {text[-MAX_MESSAGE // 2 :]}"


def _window(line: str, column: int) -> tuple[str, int]:
    """The part of a long line around `column`, and the column in that part."""
    if len(line) <= SHOWN_WIDTH:
        return line, column
    start = max(0, min(column - 1 - SHOWN_WIDTH // 3, len(line) - SHOWN_WIDTH))
    return line[start : start + SHOWN_WIDTH], column - start


def nearest(word: str, choices: Iterable[str]) -> str | None:
    """The choice that `word` most likely meant, or None when nothing is near."""
    if len(word) > MAX_WORD:
        return None
    folded: dict[str, str] = {}
    for choice in itertools.islice((choice for choice in choices if len(choice) <= MAX_WORD), MAX_CHOICES):
        folded.setdefault(choice.casefold(), choice)
    wanted = word.casefold()
    if close := difflib.get_close_matches(wanted, folded, n=1, cutoff=0.6):
        return folded[close[0]]
    holding = [choice for choice in folded if len(wanted) > 2 and wanted in choice]
    return folded[holding[0]] if len(holding) == 1 else None


def did_you_mean(word: str, choices: Iterable[str], what: str = "") -> str:
    """`did you mean 'camera/image'?`, or the list of all choices when none is near."""
    known = list(choices)
    if (near := nearest(word, known)) is not None:
        return f"did you mean {near!r}?"
    more = f" and {len(known) - LISTED:,} more" if len(known) > LISTED else ""
    return f"{what}: {', '.join(known[:LISTED]) or 'none'}{more}" if what else ""
