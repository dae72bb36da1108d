"""Logs the calls by which an operator reads clocks, entropy, addresses, files, variables: in one run, changing nothing.

The interpreter calls the trap for each call of a function, built-in ones included, however their names were imported.
Reads of compiled code, past the interpreter, are not seen.
"""

from __future__ import annotations

import os
import random
import sys
import threading
import uuid
from collections import Counter
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any

from numpy.random import bit_generator

from dataflow.causes.places import Places
from dataflow.causes.sources import (
    ENTROPY,
    FILE,
    HEAP,
    IDENTITY,
    LOCALE,
    MONOTONIC,
    NUMPY,
    PROCESS,
    RANDOM,
    THREADS,
    UUID,
    VARIABLE,
    WALL,
    kind_of,
    named,
)
from dataflow.execution.generators import lazy_numpy
from dataflow.execution.generators.shared_generators import AT_WORK

BIT_GENERATOR: Any = bit_generator
"""The module of numpy that asks `randbits` for the entropy of generators without a seed."""
_CLOCKS = {
    WALL: ("time", "time_ns", "localtime", "gmtime", "ctime", "strftime"),
    MONOTONIC: ("monotonic", "perf_counter", "process_time", "thread_time"),
}
_BUILT_IN: dict[str, tuple[str | None, str]] = {
    **{name: ("time", source) for source, names in _CLOCKS.items() for name in names},
    **{f"{name}_ns": ("time", MONOTONIC) for name in _CLOCKS[MONOTONIC]},
    **dict.fromkeys(("clock_gettime", "clock_gettime_ns"), ("time", WALL)),
    **dict.fromkeys(("datetime.now", "datetime.utcnow", "datetime.today", "date.today"), (None, WALL)),
    **dict.fromkeys(("urandom", "getrandom"), ("posix", ENTROPY)),
    **dict.fromkeys(("Random.random", "Random.getrandbits", "Random.seed"), (None, RANDOM)),
    **dict.fromkeys(("datetime.astimezone", "datetime.timestamp", "datetime.fromtimestamp"), (None, LOCALE)),
    **dict.fromkeys(("setlocale", "localeconv", "nl_langinfo"), ("_locale", LOCALE)),
    "id": ("builtins", IDENTITY),
    "getpid": ("posix", PROCESS),
    "empty": ("numpy", HEAP),
}
"""By qualified name of a built-in function: its module (None for methods), and the source that it reads."""
_ZONED = ("localtime", "strftime", "ctime", "mktime", "datetime.now", "datetime.today", "date.today")


class ForNumpy(random.SystemRandom):
    """Gives the entropy for numpy's generators that are made without a seed, and for nothing else."""

    @staticmethod
    def install() -> None:
        """Has numpy ask it rather than a generator that it shares with `secrets`."""
        BIT_GENERATOR.randbits = ForNumpy().getrandbits


@dataclass(frozen=True, slots=True)
class Site:
    """A line that led to a source: file, line, the function it is in, and the call that it makes."""

    file: str
    line: int
    function: str
    call: str


class Traps:
    """Counts the calls that read a source, by source and line of the operator's code."""

    def __init__(self, places: Places) -> None:
        self.counts: Counter[tuple[str, Site]] = Counter()
        self._places = places
        self._began = set(os.listdir("/proc/self/task"))
        self._written: set[str] = set()
        self._main = threading.get_ident()
        environ = type(os.environ)
        self._python: dict[CodeType, str] = {
            environ.__getitem__.__code__: VARIABLE,
            threading.Thread.start.__code__: THREADS,
            type(lazy_numpy.MT19937.lock).__enter__.__code__: NUMPY,
            random.SystemRandom.getrandbits.__code__: ENTROPY,
            uuid.uuid1.__code__: UUID,
            uuid.uuid4.__code__: UUID,
        }

    def set(self) -> None:
        """Begins to log, in this thread and in those to come."""
        ForNumpy.install()
        lazy_numpy.seed_lazily(random.SystemRandom().getrandbits(32))  # its lock shows who draws
        sys.addaudithook(self._opened)
        threading.setprofile(self._called)
        sys.setprofile(self._called)

    def lift(self) -> None:
        """Ends the log."""
        sys.setprofile(None)
        threading.setprofile(None)

    def threads(self) -> int:
        """Returns how many threads run in this process that did not when the trap was made."""
        return len(set(os.listdir("/proc/self/task")) - self._began)

    def _called(self, frame: FrameType, event: str, arg: Any) -> None:
        if event == "call":
            source = self._python.get(frame.f_code)
            if source is not None:
                self._note_python(source, frame)
        elif event == "c_call":
            name = getattr(arg, "__qualname__", "")
            found = _BUILT_IN.get(name)
            if found is not None and found[0] == getattr(arg, "__module__", None):
                self._note_built_in(found[1], name, frame, arg)

    def _note_python(self, source: str, frame: FrameType) -> None:
        local = frame.f_locals
        if source is VARIABLE:
            self._note(named(VARIABLE, os.fsdecode(local["key"])), f"os.environ[{local['key']!r}]", frame.f_back)
        elif source is ENTROPY:
            if isinstance(local["self"], ForNumpy):
                self._note(NUMPY, "a generator without a seed", frame.f_back)
        elif source is not NUMPY or self._unseeded():
            call = {THREADS: "Thread.start", NUMPY: "np.random"}.get(source, f"uuid.{frame.f_code.co_name}")
            self._note(source, call, frame.f_back)

    def _note_built_in(self, source: str, name: str, frame: FrameType, arg: Any) -> None:
        direct = self._places.of(frame.f_code) == "own"
        if source is RANDOM:
            if name == "Random.seed":
                if frame.f_locals.get("a", 0) is not None:
                    return
            elif arg.__self__ is not random._inst or not self._unseeded():
                return
        elif source is ENTROPY:
            if isinstance(frame.f_locals.get("self"), ForNumpy) or frame.f_globals.get("__name__") == "uuid":
                return  # noted as numpy's, or as an identifier
        elif source in (IDENTITY, HEAP) and not direct:
            return
        if self._places.passes(frame) and source in (WALL, MONOTONIC, PROCESS):
            return  # waits of the standard library
        module = "" if getattr(arg, "__module__", None) is None else f"{arg.__module__}."
        self._note(source, module.replace("posix", "os").replace("builtins.", "") + name, frame)
        if name in _ZONED:
            self._note(LOCALE, module + name, frame)

    def _unseeded(self) -> bool:
        """Returns whether a draw from a global generator depends on more than its seed: outside of calls, or in a
        thread, whose draws mix with those of others."""
        return AT_WORK.begun == AT_WORK.ended or threading.get_ident() != self._main

    def _opened(self, event: str, args: tuple[Any, ...]) -> None:
        if event != "open" or not isinstance(args[0], str | bytes) or sys.getprofile() is None:
            return
        path, flags = os.path.abspath(os.fsdecode(args[0])), args[2] or 0
        frame = sys._getframe(1)
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            self._written.add(path)
        elif path not in self._written and os.path.isfile(path) and not _imports(frame):
            self._note(named(FILE, path), "open", frame)

    def _note(self, source: str, call: str, frame: FrameType | None) -> None:
        led = self._places.led(frame)
        if led is None:
            return
        own, inside = led
        if inside is not None:
            module = inside.f_globals.get("__name__", "")
            if kind_of(source) == VARIABLE and module not in ("os", "collections.abc"):
                return  # what subprocess, tempfile and others look up for themselves
            call = f"{module}.{inside.f_code.co_qualname} → {call}"
        self.counts[source, Site(own.f_code.co_filename, own.f_lineno, own.f_code.co_name, call)] += 1


def _imports(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
