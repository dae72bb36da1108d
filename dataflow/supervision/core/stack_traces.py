"""Shortens the stacks in what a process said last to what its operators, and libraries under them, are at."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final

_THREAD: Final = re.compile(r"(Current thread|Thread) 0x[0-9a-f]+ .*\(most recent call first\):$")
_FRAME: Final = re.compile(r'  File "(?P<file>.*)", line \d+ in (?P<function>.*)$')
_CALL: Final = "dataflow/execution/calls.py"
"""File in which the engine calls an operator: what lies outside of it is the same for all."""
_UNSAID: Final = ("<frozen importlib", "<frozen runpy")
_LISTENER: Final = ("dataflow/supervision/process_main.py", "_listen")
"""The thread that waits for the supervisor's messages: every process has it, and it is never the late one."""


def shortened(lines: Iterable[str]) -> list[str]:
    """Returns lines, of whose stacks (those of `faulthandler`) are left: frames down to the engine's call of an
    operator, without those of the import system, of all threads but the one that listens to the supervisor."""
    kept: list[str] = []
    for number, (header, body) in enumerate(_blocks(lines)):
        if header is None:
            kept += body if number else _without_a_torn_stack(body)
        elif not any(_is(line, *_LISTENER) for line in body):
            kept += [header, *_down_to_the_call(body)]
    return kept


def _blocks(lines: Iterable[str]) -> Iterator[tuple[str | None, list[str]]]:
    """Divides lines into stacks, each with its header, and what stands between them."""
    header: str | None = None
    body: list[str] = []
    for line in lines:
        if _THREAD.match(line):
            yield header, body
            header, body = line, []
        elif header is not None and not _FRAME.match(line):
            yield header, body
            header, body = None, [line] if line.strip() else []
        else:
            body.append(line)
    yield header, body


def _without_a_torn_stack(words: list[str]) -> list[str]:
    """Returns words that may begin with the rest of a stack, whose innermost frames were not kept."""
    first = next((number for number, line in enumerate(words) if not _FRAME.match(line)), len(words))
    calls = any(_is(line, _CALL) for line in words[:first])
    return [*(_down_to_the_call(words[:first]) if calls else []), *words[first:]]


def _down_to_the_call(frames: list[str]) -> list[str]:
    calls = [number for number, line in enumerate(frames) if _is(line, _CALL)]
    inside = frames[: calls[0]] if calls and calls[0] else frames
    return [line for line in inside if not any(unsaid in line for unsaid in _UNSAID)]


def _is(line: str, file: str, function: str = "") -> bool:
    found = _FRAME.match(line)
    return found is not None and found["file"].endswith(file) and found["function"].endswith(function)
