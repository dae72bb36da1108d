"""Counts how many of some random faults in a package its tests find.

usage: python tools/mutants.py PACKAGE [--tests FOLDER] [--count N] [--seed N] [--quick]   (PACKAGE: dataflow/sync)

A mutant differs from the package in one place: a comparison, an operator of arithmetic or logic, a number, a returned
value or a dropped statement. Equal seeds draw equal mutants of equal sources, so that the tests of two commits can be
compared. The tests run in a copy of the checkout, and end at the first that fails.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
COPIED = (
    "dataflow",
    "operators",
    "tests",
    "tools",
    "graphs",
    "recordings",
    "docs",
    "benchmarks",
    "pyproject.toml",
    "README.md",
)
LIMIT = 600
"""Seconds after which the tests of a mutant count as failed."""

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


def passes(checkout: Path, tests: str, quick: bool = False) -> bool:
    """Runs tests, up to the first that fails, in a copy of the checkout; `quick` leaves the long ones out."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider", "--timeout", "120", tests]
    command += ["-m", "not long"] if quick else []
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    environment.setdefault("PERCEPTION_DATA", str(REPOSITORY.parent / "shared" / "data"))
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    ended = subprocess.Popen(command, cwd=checkout, env=environment, start_new_session=True, **quiet)
    try:
        return ended.wait(LIMIT) == 0
    except subprocess.TimeoutExpired:
        return False
    finally:
        with contextlib.suppress(ProcessLookupError):  # none is left of its group
            os.killpg(ended.pid, signal.SIGKILL)
        ended.wait()


def main(arguments: list[str] | None = None) -> int:
    """Prints each mutant with its fate; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("package", type=Path)
    parser.add_argument("--tests", help="default: the folder that mirrors the package")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="leave long tests out, as a bare `pytest` does")
    given = parser.parse_args(arguments)
    package = given.package
    tests = given.tests or str(Path("tests", *package.parts[package.parts[0] == "dataflow" :]))
    with tempfile.TemporaryDirectory() as folder:
        checkout = Path(folder)
        for name in COPIED:
            source = REPOSITORY / name
            (shutil.copytree if source.is_dir() else shutil.copy2)(source, checkout / name)
        started = time.monotonic()
        if not passes(checkout, tests, given.quick):
            print(f"{tests} fails without any mutant", file=sys.stderr)
            return 2
        print(f"{tests} passes in {time.monotonic() - started:.0f} s", flush=True)
        killed = 0
        os.chdir(checkout)
        mutants = drawn(package, given.count, given.seed)
        for mutant in mutants:
            source_of = mutant.file.read_bytes()
            mutant.file.write_bytes(mutant.written(source_of))
            found = not passes(checkout, tests, given.quick)
            mutant.file.write_bytes(source_of)
            killed += found
            print(f"{'killed  ' if found else 'SURVIVED'} {mutant}", flush=True)
    print(f"{killed} of {len(mutants)} killed (seed {given.seed})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
