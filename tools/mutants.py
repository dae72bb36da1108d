"""Counts how many of some random faults in a package its tests find.

usage: python tools/mutants.py PACKAGE [--tests FOLDER] [--count N] [--seed N] [--quick]  (PACKAGE: dataflow/sync)

A mutant differs from the package in one place: a comparison, an operator of arithmetic or logic, a number, a returned
value or a dropped statement. Equal seeds draw equal mutants of equal sources, so that the tests of two commits can be
compared. In a copy of the checkout, those tests are run that run the mutant's lines, file by file, up to the first that
fails. A mutant in lines that no test runs is one that they do not find.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from warm_tests import WarmTests

REPOSITORY = Path(__file__).resolve().parent.parent
FOLDERS = ("dataflow", "operators", "tests", "tools", "graphs", "recordings", "docs", "benchmarks")
COPIED = (*FOLDERS, "pyproject.toml", "README.md")

OTHER: dict[type[ast.AST], type[ast.AST]] = {}
for one, other in (
    (ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn),
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or), (ast.BitAnd, ast.BitOr), (ast.LShift, ast.RShift),
):  # fmt: skip
    OTHER |= {one: other, other: one}
OTHER |= {ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Mult}


@dataclass(frozen=True)
class Mutant:
    """One place of a file, and what stands there instead."""

    file: Path
    line: int
    start: int
    end: int
    text: str

    def written(self, source: bytes) -> bytes:
        return source[: self.start] + self.text.encode() + source[self.end :]

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {' '.join(self.text.split())[:90]}"


def mutants_of(file: Path, source: bytes) -> Iterator[Mutant]:
    """Yields every mutant of a file, in the order of the syntax tree."""
    lengths = [0]
    for line in source.splitlines(keepends=True):
        lengths.append(lengths[-1] + len(line))
    for node in _code(ast.parse(source)):
        text = _instead(node)
        if text is not None:
            assert node.end_lineno is not None
            assert node.end_col_offset is not None
            start, end = lengths[node.lineno - 1] + node.col_offset, lengths[node.end_lineno - 1] + node.end_col_offset
            yield Mutant(file, node.lineno, start, end, text)


def _code(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Yields statements and expressions that are executed: no annotations, docstrings or parts of f-strings."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                if isinstance(child, ast.expr | ast.stmt):
                    yield child
                yield from _code(child)


def _instead(node: ast.expr | ast.stmt) -> str | None:
    """Returns the source that replaces a node; None for a node that is left alone."""
    match node:
        case ast.Compare(ops=[operator]) if type(operator) in OTHER:
            changed: ast.AST = ast.Compare(node.left, [OTHER[type(operator)]()], node.comparators)  # type: ignore[list-item]
        case ast.BinOp() | ast.BoolOp() if type(node.op) in OTHER and not _is_type(node):
            changed = ast.copy_location(type(node)(**{**vars(node), "op": OTHER[type(node.op)]()}), node)
        case ast.UnaryOp(op=ast.Not()):
            changed = node.operand
        case ast.Constant(value=bool() as value):
            return str(not value)
        case ast.Constant(value=int() | float() as value):
            return f"({value + 1!r})"
        case ast.Return(value=ast.expr() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            return "return None"
        case ast.Expr(value=ast.Call()) | ast.Assign(targets=[ast.Attribute() | ast.Subscript()]) | ast.AugAssign():
            return "pass"
        case _:
            return None
    return f"({ast.unparse(changed)})"


def _is_type(node: ast.BinOp | ast.BoolOp) -> bool:
    """Whether it is a union of types, such as `int | None`, rather than arithmetic."""
    return isinstance(node.op, ast.BitOr) and any(
        isinstance(side, ast.Constant) or (isinstance(side, ast.Name) and side.id[:1].isupper())
        for side in (node.left, node.right)
    )


def drawn(package: Path, count: int, seed: int) -> list[Mutant]:
    """Returns `count` mutants of a file or of those of a package, equal ones for equal sources and seeds."""
    files = sorted(package.rglob("*.py")) if package.is_dir() else [package]
    every = [mutant for file in files for mutant in mutants_of(file, file.read_bytes())]
    return random.Random(seed).sample(every, min(count, len(every)))


def lines_of(mutant: Mutant, source: bytes) -> set[int]:
    """Returns the lines of which one runs when the mutant's code does: its own and the first of its statement."""
    around = [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.stmt) and node.lineno <= mutant.line <= (node.end_lineno or node.lineno)
    ]
    return {max(around), *range(mutant.line, mutant.line + source[mutant.start : mutant.end].count(b"\n") + 1)}


class Room:
    """The tests of a package in a copy of the checkout: which lines each of them runs, and how long it takes."""

    def __init__(self, tests: WarmTests, checkout: Path, package: Path, files: list[str]) -> None:
        self._tests = tests
        self._checkout = checkout
        self._reaching: dict[str, dict[tuple[str, int], set[str]]] = {}
        """By file of tests: the tests that run each (file, line); "" stands for all of them."""
        self._always: set[str] = set()
        """Tests, and files of tests, of which it is not known."""
        for file in files:
            outcome, self._reaching[file] = tests.traced(file, package)
            tests.warm(outcome.modules)
            if not outcome.passed:
                unknown = outcome.failed or [file]
                print(f"run for every mutant, as it fails while lines are traced: {', '.join(unknown)}", flush=True)
                self._always.update(unknown)
        self.whole = tests.run(files, limit=3600)
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # a mutant's would pass for that of a file of equal size and second
        sys.dont_write_bytecode = True

    def kills(self, mutant: Mutant) -> str | None:
        """Returns the test that fails for a mutant; "" where each passes that might have, None where none runs it."""
        path = self._checkout / mutant.file
        source, status = path.read_bytes(), path.stat()
        places = [(str(mutant.file), line) for line in lines_of(mutant, source)]
        chosen = {file: tests for file in self._reaching if (tests := self._chosen(file, places))}
        path.write_bytes(mutant.written(source))
        try:
            for file, tests in sorted(chosen.items(), key=lambda each: self._duration(each[1])):
                longest = max(self.whole.seconds[test] for test in tests)
                limit = 120 + 5 * self._duration(tests)
                outcome = self._tests.run([file], tests, limit=limit, timeout=20 + 10 * longest)
                if not outcome.passed:
                    return outcome.failed[0] if outcome.failed else f"{file} ended early or late"
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
        return "" if chosen else None

    def _chosen(self, file: str, places: list[tuple[str, int]]) -> list[str]:
        """Returns the tests of a file that run one of some lines, quick ones first; all where they share what does."""
        reaching = set().union(*(self._reaching[file].get(place, ()) for place in places))
        every = [test for test in self.whole.seconds if test.partition("::")[0] == file]
        if file not in self._always and "" not in reaching:
            every = [test for test in every if test in reaching | self._always]
        return sorted(every, key=self.whole.seconds.__getitem__)

    def _duration(self, tests: list[str]) -> float:
        return float(sum(self.whole.seconds[test] for test in tests))


def main(arguments: list[str] | None = None) -> int:
    """Prints each mutant with its fate; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=Path)
    parser.add_argument("--tests", nargs="+", help="files or folders; default: the folder that mirrors the package")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="leave long tests out, as a bare `pytest` does")
    parser.add_argument("--checkout", type=Path, default=REPOSITORY, help="whose package and tests; default: this")
    given = parser.parse_args(arguments)
    package = given.package
    named = given.tests or [str(Path("tests", *package.parts[package.parts[0] == "dataflow" :]))]
    os.environ.setdefault("PERCEPTION_DATA", str(given.checkout.resolve().parent / "shared" / "data"))
    started = time.monotonic()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the copy and its tests are gone then, too
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        checkout = Path(folder, "checkout")
        copy(given.checkout, checkout)
        os.chdir(checkout)
        files = sorted({str(file) for name in named for file in test_files(Path(name))})
        room = Room(WarmTests(checkout, Path(folder), given.quick), checkout, package, files)
        if not room.whole.passed:
            print(f"without any mutant: {room.whole.failed or 'no end'}", file=sys.stderr)
            return 2
        seconds = room.whole.seconds
        print(f"{len(seconds)} tests pass in {sum(seconds.values()):.0f} s", flush=True)
        fates = []
        for mutant in drawn(package, given.count, given.seed):
            fates.append(room.kills(mutant))
            fate = "NOT RUN " if fates[-1] is None else "killed  " if fates[-1] else "SURVIVED"
            print(f"{fate} {mutant}{f'  [{fates[-1]}]' if fates[-1] else ''}", flush=True)
    print(f"{sum(map(bool, fates))} of {len(fates)} killed (seed {given.seed}) in {time.monotonic() - started:.0f} s")
    return 0


def copy(source: Path, checkout: Path) -> None:
    """Copies what tests read of a checkout, as far as it has it."""
    checkout.mkdir()
    for each in (source / name for name in COPIED):
        if each.exists():
            (shutil.copytree if each.is_dir() else shutil.copy2)(each, checkout / each.name)


def test_files(named: Path) -> Iterator[Path]:
    """Yields the modules of tests of a file or folder."""
    yield from named.rglob("test_*.py") if named.is_dir() else [named]


if __name__ == "__main__":
    sys.exit(main())
