"""Line events of one call of an operator: counts them, and stops at some."""

from __future__ import annotations

import inspect
import sys
import sysconfig
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, NamedTuple

from dataflow.debugging.fired import Process
from dataflow.messages.base import Message
from dataflow.sync import Firing

_ENGINE = Path(__file__).resolve().parent.parent
_STANDARD = Path(sysconfig.get_path("stdlib")).resolve()


class CodePosition(NamedTuple):
    """A place in a call: the beginning of a line for the time of that number, from 1. It stays where other calls have
    filled caches, which a count of all lines does not."""

    file: str
    line: int
    time: int


Homes = tuple[Path, ...]
"""The folders of the operator's top package, or its file."""


class Lines:
    """Makes a call, and calls `at_line` for each line of the operator's source that begins, with its number from 1.

    Sees the thread of the call; neither libraries nor the engine, nor modules that a call imports.
    """

    def __init__(self, at_line: Callable[[FrameType, int], None], homes: Homes) -> None:
        self._at_line, self._homes = at_line, homes
        self._times: Counter[tuple[str, int]] = Counter()
        self.count = 0
        self.raised: tuple[BaseException | None, int] = None, 0
        """The last exception that came up, and the number of the line that raised it."""

    def through(self, process: Process, firing: Firing) -> dict[str, Message]:
        """Makes the call. Raises what it raises, and what `at_line` does."""
        before = sys.gettrace()
        sys.settrace(self._entered)
        try:
            return process(firing)
        finally:
            sys.settrace(before)

    def spot(self, frame: FrameType) -> CodePosition:
        """Returns the place where a frame has just begun a line."""
        place = frame.f_code.co_filename, frame.f_lineno
        return CodePosition(*place, self._times[place])

    def _entered(self, frame: FrameType, event: str, arg: Any) -> Any:
        code = frame.f_code
        return self._traced if code.co_name != "<module>" and is_own(code.co_filename, self._homes) else None

    def _traced(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line":
            self.count += 1
            self._times[frame.f_code.co_filename, frame.f_lineno] += 1
            self._at_line(frame, self.count)
        elif event == "exception" and arg[1] is not self.raised[0]:
            self.raised = arg[1], self.count
        return self._traced


def homes_of(module: str) -> Homes:
    """Returns where the source lies of the package, or the module, that an operator's module belongs to."""
    top = sys.modules[module.partition(".")[0]]
    return tuple(Path(path).resolve() for path in getattr(top, "__path__", [top.__file__]) if path)


@cache
def is_own(file: str, homes: Homes) -> bool:
    """Returns whether a source file is an operator's: of its package wherever that is installed, else neither a
    library's nor the engine's."""
    path = Path(file).resolve()
    within = {path, *path.parents}
    library = {"site-packages", "dist-packages"} & {*path.parts} or _STANDARD in within
    return path.suffix == ".py" and _ENGINE not in within and not (library and within.isdisjoint(homes))


def own_frames(frame: FrameType | None, homes: Homes) -> Iterator[FrameType]:
    """The frames of the operator's source, the innermost first."""
    while frame is not None:
        if _ENGINE in Path(frame.f_code.co_filename).parents:
            return
        if is_own(frame.f_code.co_filename, homes):
            yield frame
        frame = frame.f_back


class Part(NamedTuple):
    """A function of a source file, or what runs when it is imported (`function` is False): `name` as `__qualname__`,
    the line where it begins, and the lines of its body that hold code."""

    name: str
    function: bool
    begins: int
    lines: frozenset[int]


def source_parts(file: str) -> list[Part]:
    """Returns the parts of a source file. Raises OSError, SyntaxError."""
    return list(_parts(compile(Path(file).read_bytes(), file, "exec")))


def _parts(code: CodeType) -> Iterator[Part]:
    lines = {line for _, _, line in code.co_lines() if line}
    function = bool(code.co_flags & inspect.CO_OPTIMIZED) or "<locals>" in code.co_qualname
    body = lines - {code.co_firstlineno} if function else lines
    yield Part(code.co_qualname, function, code.co_firstlineno, frozenset(body or lines))
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _parts(inner)


def stoppable_line(file: str, wanted: int, setup: str) -> int:
    """Returns the first line with code from `wanted` on, or that of the function whose head is there. Raises
    LookupError where there is none, or it runs before the first call: in the function `setup`, a class, the module;
    OSError, SyntaxError, ValueError."""
    parts = source_parts(file)
    lines = {n for part in parts for n in (*part.lines, part.begins)}
    if (found := min((n for n in lines if n >= wanted), default=None)) is None:
        raise LookupError(f"no code from line {wanted} on: the last line with code is {max(lines, default=0)}")
    made = [part for part in parts if part.function and part.name != setup]
    there = [found for part in made if found in part.lines]
    there += [min(part.lines) for part in made if part.begins <= found < min(part.lines)]
    if not there:
        raise LookupError(f"line {found} runs before the first recorded call: breakpoints are for what the calls run")
    return min(there)
