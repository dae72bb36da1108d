"""Runs tests of a checkout in forks of a process that has imported the libraries they need once.

The parent imports no module of the checkout: each fork sees its files as they are then. A fork and what it started are
killed when its tests end.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import line_tracer
import pytest

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_name, "1")  # as in tests/conftest.py, before a library reads it

PR_SET_CHILD_SUBREAPER = 36


@dataclass
class Outcome:
    """Outcome of a run of tests: whether all passed, those that failed, seconds by test, libraries it imported."""

    passed: bool = False
    failed: list[str] = field(default_factory=list)
    """Empty where the run itself ended too early or too late."""
    seconds: dict[str, float] = field(default_factory=dict)
    modules: list[str] = field(default_factory=list)


class _Plugin:
    """Chooses tests, names them to the tracer, and notes the outcome."""

    def __init__(self, chosen: Sequence[str] | None, tracer: line_tracer.LineTracer | None) -> None:
        self._rank = None if chosen is None else {test: index for index, test in enumerate(chosen)}
        self._tracer = tracer
        self._test = ""
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._failed: list[str] = []

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        if (rank := self._rank) is not None:
            items[:] = sorted((item for item in items if item.nodeid in rank), key=lambda item: rank[item.nodeid])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        self._test = item.nodeid
        self._trace(item.nodeid)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[object]) -> Generator[None, object, object]:
        """Names what several tests share by none of them."""
        self._trace(self._test if fixturedef.scope == "function" else "")
        try:
            return (yield)
        finally:
            self._trace(self._test)

    def _trace(self, test: str) -> None:
        if self._tracer is not None:
            self._tracer.start(test)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        self._note(report)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._seconds[report.nodeid] += report.duration
        self._note(report)

    def _note(self, report: pytest.CollectReport | pytest.TestReport) -> None:
        if report.failed and report.nodeid not in self._failed:
            self._failed.append(report.nodeid)

    def outcome(self, passed: bool) -> Outcome:
        files = [(name, getattr(module, "__file__", None) or "") for name, module in [*sys.modules.items()]]
        libraries = [name for name, file in files if "site-packages" in file]
        return Outcome(passed, self._failed, dict(self._seconds), libraries)


class WarmTests:
    """Runs tests in a copy of a checkout; files that it makes itself are in `folder`."""

    def __init__(self, checkout: Path, folder: Path, quick: bool = False) -> None:
        self._checkout = checkout
        self._folder = folder
        self._options = ["-q", "-n0", "-p", "no:cacheprovider", "--basetemp", str(folder / "tests")]
        self._options += ["-m", "not long"] if quick else []
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)  # orphans become children of this process, which ends them

    def run(
        self, files: Sequence[str], chosen: Sequence[str] | None = None, limit: float = 600, timeout: float = 120
    ) -> Outcome:
        """Runs the tests of files, or those `chosen` of them in that order, up to the first that fails, for at most
        `limit` s and each for at most `timeout` s."""
        return self._forked(["-x", *files], chosen, limit, timeout, None)

    def traced(self, file: str, package: Path, limit: float = 600) -> tuple[Outcome, dict[tuple[str, int], set[str]]]:
        """Runs the tests of a file; returns also which of them ran each (file, line) of a package of the checkout.

        "" among them is what they share: collection, and fixtures of a module or more. Where one fails, the others go
        on.
        """
        lines = self._folder / "lines"
        lines.unlink(missing_ok=True)
        customize = self._checkout / "sitecustomize.py"
        customize.write_bytes(Path(line_tracer.__file__).read_bytes())
        traced = {line_tracer.WHERE: str(lines), line_tracer.WHOSE: str(self._checkout / package)}
        try:
            outcome = self._forked([file], None, limit, 300, traced)
        finally:
            customize.unlink()
        reached: defaultdict[tuple[str, int], set[str]] = defaultdict(set)
        for text in lines.read_text().splitlines() if lines.exists() else ():
            test, name, line = text.rsplit("\t", 2)
            reached[os.path.relpath(name, self._checkout), int(line)].add(test)
        return outcome, reached

    def warm(self, modules: Sequence[str]) -> None:
        """Imports libraries here, so that no later fork does."""
        for name in modules:
            with contextlib.suppress(Exception):  # a library that needs what the tests had set up: each fork imports it
                importlib.import_module(name)

    def _forked(
        self,
        arguments: Sequence[str],
        chosen: Sequence[str] | None,
        limit: float,
        timeout: float,
        traced: dict[str, str] | None,
    ) -> Outcome:
        file = self._folder / "outcome"
        file.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            try:
                self._child([*arguments, "--timeout", f"{timeout:.0f}"], chosen, traced, file)
            finally:
                os._exit(0)
        try:
            end = time.monotonic() + limit
            while not _ended(child):
                if time.monotonic() > end:
                    return Outcome()
                time.sleep(0.01)
        finally:
            _kill(child)
        return Outcome(**json.loads(file.read_text())) if file.exists() else Outcome()

    def _child(
        self, arguments: list[str], chosen: Sequence[str] | None, traced: dict[str, str] | None, file: Path
    ) -> None:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        nothing = os.open(os.devnull, os.O_RDWR)
        for standard in range(3):
            os.dup2(nothing, standard)
        os.chdir(self._checkout)
        os.environ.update(PYTHONPATH=str(self._checkout), **traced or {})
        sys.path.insert(0, str(self._checkout))
        sys.argv = ["pytest"]
        tracer = line_tracer.from_environment() if traced else None
        if tracer is not None:
            tracer.start("")
        plugin = _Plugin(chosen, tracer)
        code = pytest.main([*self._options, *arguments], plugins=[plugin])
        sys.settrace(None)
        part = file.with_suffix(".part")
        part.write_text(json.dumps(vars(plugin.outcome(code in (0, 5)))))  # 5: none is left of them, such as long ones
        part.rename(file)


def _ended(child: int) -> bool:
    """Waits for what has ended, also for processes whose parents ended before; returns whether the child has."""
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG)[0]) != 0:
            if ended == child:
                return True
    return False


def _kill(child: int) -> None:
    """Kills a fork, its group and every process that it left in another."""
    with contextlib.suppress(ProcessLookupError):  # none is left of it
        os.killpg(child, signal.SIGKILL)
    while left := Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
        for process in left:
            os.kill(int(process), signal.SIGKILL)
            os.waitpid(int(process), 0)
