"""Writes which lines of a package each test runs, in this process, its forks and every Python that it starts.

A copy named `sitecustomize.py` on the PYTHONPATH traces from the start of a process where the environment asks for it.
"""

from __future__ import annotations

import os
import sys
import threading
from types import FrameType
from typing import Any

WHERE = "LINE_TRACER_FILE"
"""Environment: the file to which lines are appended as `test<TAB>file<TAB>line`."""
WHOSE = "LINE_TRACER_PACKAGE"
"""Environment: the folder or file whose lines are written."""
WHICH = "LINE_TRACER_TEST"
"""Environment: the test under way, for the processes that it starts."""
_open, _write, _close, _flags = os.open, os.write, os.close, os.O_WRONLY | os.O_APPEND | os.O_CREAT
# kept: a test may replace those of the module


class LineTracer:
    """A trace function that writes each line once per test; `None` for frames of other files keeps them fast."""

    def __init__(self, file: str, package: str) -> None:
        self._file = file
        self._package = package
        self._test = ""
        self._seen: set[tuple[str, int]] = set()
        self._traced: dict[str, bool] = {}

    def start(self, test: str) -> None:
        """Traces this process and its threads from now on, under the name of a test, or "" for what several share."""
        self._test = os.environ[WHICH] = test
        self._seen = set()
        threading.settrace(self.call)
        sys.settrace(self.call)

    def call(self, frame: FrameType, event: str, argument: object) -> Any:
        name = frame.f_code.co_filename
        traced = self._traced.get(name)
        if traced is None:
            traced = self._traced[name] = name == self._package or name.startswith(self._package + os.sep)
        return self.line if traced else None

    def line(self, frame: FrameType, event: str, argument: object) -> Any:
        place = frame.f_code.co_filename, frame.f_lineno
        if place not in self._seen:
            self._seen.add(place)
            file = _open(self._file, _flags)  # not held open: the process may close what it does not know
            _write(file, f"{self._test}\t{place[0]}\t{place[1]}\n".encode())
            _close(file)
        return self.line


def from_environment() -> LineTracer:
    """Returns the tracer that the environment asks for."""
    return LineTracer(os.environ[WHERE], os.environ[WHOSE])


if __name__ == "sitecustomize" and WHERE in os.environ:
    from_environment().start(os.environ.get(WHICH, ""))
