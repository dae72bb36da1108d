"""Logs the calls by which an operator reads clocks, entropy, addresses, files, variables: in one run, changing nothing.

The interpreter calls the trap for each call of a function, built-in ones included, however their names were imported.
Reads of compiled code, past the interpreter, are not seen.
"""

from __future__ import annotations

import importlib
import os
import random
import sys
import threading
import uuid
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from types import CodeType, FrameType
from typing import Any

from numpy.random import bit_generator

from dataflow.causes.places import Places
from dataflow.causes.sources import (
    ENTROPY,
    FILE,
    FOLDER,
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
    WORKING,
    kind_of,
    named,
)
from dataflow.execution.generators import lazy_numpy
from dataflow.execution.generators.shared_generators import CALLS_IN_PROGRESS

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
    **dict.fromkeys(("getcwd", "getcwdb"), ("posix", WORKING)),
    "empty": ("numpy", HEAP),
}
"""By qualified name of a built-in function: its module (None for methods), and the source that it reads."""
_IMPORTLIB = os.path.dirname(importlib.__file__)
_SOURCE = (".py", ".pyc", ".so")
_LOOKS = {name: getattr(os, name) for name in ("stat", "lstat")}
_ZONED = ("localtime", "strftime", "ctime", "mktime", "datetime.now", "datetime.today", "date.today")


class NumpyEntropy(random.SystemRandom):
    """Gives the entropy for numpy's generators that are made without a seed, and for nothing else."""

    @staticmethod
    def install() -> None:
        """Has numpy ask it rather than a generator that it shares with `secrets`."""
        BIT_GENERATOR.randbits = NumpyEntropy().getrandbits


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
            looking_at.__code__: FILE,
        }

    def set(self) -> None:
        """Begins to log, in this thread and in those to come."""
        NumpyEntropy.install()
        lazy_numpy.seed_lazily(random.SystemRandom().getrandbits(32))  # its lock shows which call draws
        look_through(looking_at)
        sys.addaudithook(self._audited)
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
        elif source is FILE:
            asked = frame.f_back  # that of `look_through`
            self._note_path(local["path"], f"os.{local['name']}", asked and asked.f_back)
        elif source is ENTROPY:
            if isinstance(local["self"], NumpyEntropy):
                self._note(NUMPY, "a generator without a seed", frame.f_back)
        elif source is not NUMPY or self._unseeded():
            call = {THREADS: "Thread.start", NUMPY: "np.random"}.get(source, f"uuid.{frame.f_code.co_name}")
            self._note(source, call, frame.f_back)

    def _note_built_in(self, source: str, name: str, frame: FrameType, arg: Any) -> None:
        direct = self._places.owner(frame) == "own"
        if source is RANDOM:
            if name == "Random.seed":
                if frame.f_locals.get("a", 0) is not None:
                    return
            elif arg.__self__ is not random._inst or not self._unseeded():
                return
        elif source is ENTROPY:
            if isinstance(frame.f_locals.get("self"), NumpyEntropy) or frame.f_globals.get("__name__") == "uuid":
                return  # noted as numpy's, or as an identifier
        elif source in (IDENTITY, HEAP) and not direct:
            return
        if self._places.passes(frame) and source in (MONOTONIC, PROCESS):
            return  # waits of the standard library
        if source is WALL and self._places.asked_by(frame) == "engine":
            return
        module = "" if getattr(arg, "__module__", None) is None else f"{arg.__module__}."
        self._note(source, module.replace("posix", "os").replace("builtins.", "") + name, frame)
        if name in _ZONED:
            self._note(LOCALE, module + name, frame)

    def _unseeded(self) -> bool:
        """Returns whether a draw from a global generator depends on more than its seed: outside of calls, or in a
        thread, whose draws mix with those of others."""
        return CALLS_IN_PROGRESS.begun == CALLS_IN_PROGRESS.ended or threading.get_ident() != self._main

    def _audited(self, event: str, args: tuple[Any, ...]) -> None:
        if sys.getprofile() is None:
            return
        if event == "os.mkdir":
            self._written.add(absolute(args[0]) or "")
        elif event in ("os.listdir", "os.scandir"):
            self._note_path(args[0] or ".", event, sys._getframe(1))
        elif event == "open" and (args[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            self._written.add(absolute(args[0]) or "")
        elif event == "open":
            self._note_path(args[0], "open", sys._getframe(1))

    def _note_path(self, given: object, call: str, frame: FrameType | None) -> None:
        """Notes a file that is read or looked at, a folder that is listed: neither what this process has written, nor
        what the import of a module reads."""
        path = absolute(given)
        lists = call in ("os.listdir", "os.scandir")
        if path is None or path in self._written or not (os.path.isdir(path) if lists else os.path.isfile(path)):
            return
        if call != "open" and path.endswith(_SOURCE):
            return  # for tracebacks and warnings
        if not self._imports(frame):
            self._note(named(FOLDER if lists else FILE, path), call, frame)

    def _imports(self, frame: FrameType | None) -> bool:
        """Returns whether the innermost line of own code imports a module, or looks for packages: what is read then are
        source, bytecode, and files of libraries. Own code may read files while it is itself imported."""
        while frame is not None and self._places.of(frame.f_code) != "own":
            if frame.f_code.co_filename.startswith(("<frozen importlib", _IMPORTLIB)):
                return True
            frame = frame.f_back
        return False

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


def looking_at(name: str, path: Any, args: Any, kwargs: Any) -> Any:
    """Calls `os.stat` or `os.lstat`, which raise no audit event."""
    return _LOOKS[name](path, *args, **kwargs)


def look_through(look: Callable[[str, Any, Any, Any], Any]) -> None:
    """Has code that asks for facts of a file ask `look`: name of the call, path, and what else it was given. Imports
    of modules ask past it."""

    def through(name: str) -> Callable[..., Any]:
        return lambda path, *args, **kwargs: look(name, path, args, kwargs)

    for name, real in _LOOKS.items():
        setattr(os, name, through(name))
        for able in (os.supports_dir_fd, os.supports_fd, os.supports_follow_symlinks):
            able.update({getattr(os, name)} if real in able else ())


def absolute(given: object) -> str | None:
    """Returns the absolute path of what a call was given; None for a descriptor."""
    return os.path.abspath(os.fsdecode(given)) if isinstance(given, str | bytes | os.PathLike) else None
