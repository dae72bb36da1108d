"""Fixes sources of chance in this process, or changes what they give: before any code of an operator is imported.

A fixed source gives the same in every process: clocks go on by a millisecond a call, entropy comes from a counter,
`id()` numbers the objects that it is asked for, fresh memory has one pattern.
"""

from __future__ import annotations

import builtins
import ctypes
import functools
import gc
import itertools
import os
import random
import sys
import threading
import time
import uuid
import weakref
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import ThreadPoolExecutor
from datetime import date, datetime, tzinfo
from functools import partial
from multiprocessing.pool import ThreadPool
from types import FrameType
from typing import Any

import numpy as np
import xxhash

from dataflow.causes.places import Places
from dataflow.causes.sources import (
    ADDRESSES,
    ENTROPY,
    FILE,
    FOLDER,
    HEAP,
    IDENTITY,
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
    name_of,
)
from dataflow.causes.traps import BIT_GENERATOR, ForNumpy, absolute, look_through, looking_at
from dataflow.execution.generators import lazy_numpy

TICK_NS = 1_000_000
TURN = 0.2
"""Seconds for which a thread is waited for where it starts."""
LATER_NS = 400 * 86_400 * 10**9 + 3_723 * 10**9
"""By how much the time of day is changed: more than a year, and neither whole days nor whole hours."""
HERE = "/proc/self/cwd"
"""Another name of the working folder, by which the same files are found."""
_ADDRESS_OF = id
FILL, OTHER_FILL = 0x5A, 0xA7


class Interventions:
    """Replaces functions of Python and numpy. `began`: the time of day (ns) that a fixed clock begins with."""

    def __init__(self, places: Places, began: int) -> None:
        self._places, self._began = places, began
        self._fixed: frozenset[str] = frozenset()
        self._numbered: dict[str, dict[int, tuple[int, object]]] = {IDENTITY: {}, ADDRESSES: {}}
        self._count = Counter[str]()
        self.given: set[str] = set()
        """The sources of which something fixed was given to code that is not the engine's or the standard library's."""
        self._drawn = Counter[str]()

    def fix(self, sources: Collection[str]) -> None:
        """Makes sources give the same in every process; the others give their real values."""
        self._fixed = frozenset(sources)
        ForNumpy.install()
        self._set_clock(self._ticking(self._began), partial(self._gives, WALL))
        self._fix_monotonic()
        self._fix_random()
        self._fix_numpy()
        self._fix_identifiers()
        self._fix_entropy()
        self._fix_identities()
        self._replace(os, "getpid", lambda: 4242, partial(self._gives, PROCESS))
        self._take_turns()
        self._fill(FILL if HEAP in self._fixed else OTHER_FILL)
        self.given.clear()

    def vary(self, sources: Collection[str]) -> None:
        """Makes sources give something else than they do here."""
        hidden = {name_of(source) for source in sources if kind_of(source) in (FILE, FOLDER)}
        if hidden:
            _hide(hidden)
        for source in sources:
            if kind_of(source) == VARIABLE:
                os.environ[name_of(source)] = changed(os.environ.get(name_of(source)))
        if WORKING in sources:
            for name, value in (("getcwd", HERE), ("getcwdb", HERE.encode())):
                setattr(os, name, self._for_own(getattr(os, name), value))
        if WALL in sources:
            real = time.time_ns
            self._set_clock(lambda: real() + LATER_NS, lambda: True)
        if HEAP in sources and not self._fixed:
            self._fill(OTHER_FILL)

    def _gives(self, source: str) -> bool:
        """Returns whether a source is fixed; it is asked for one now."""
        if source in self._fixed:
            self.given.add(source)
        return source in self._fixed

    def _replace(self, module: Any, name: str, value: Callable[..., Any], on: Callable[[], bool]) -> None:
        """Has all code but the engine and the standard library get `value` from a function, while it is `on`."""
        real = getattr(module, name)

        @functools.wraps(real)
        def replaced(*args: Any, **kwargs: Any) -> Any:
            return (real if self._places.passes(sys._getframe(1)) or not on() else value)(*args, **kwargs)

        setattr(module, name, replaced)

    def _for_own(self, real: Callable[[], Any], value: Any) -> Callable[[], Any]:
        """Gives `value` where own code asks, itself or by the standard library."""

        def asked() -> Any:
            frame: FrameType | None = sys._getframe(1)
            while frame is not None and self._places.of(frame.f_code) == "standard":
                frame = frame.f_back
            return value if frame is not None and self._places.of(frame.f_code) == "own" else real()

        return asked

    def _ticking(self, start: int) -> Callable[[], int]:
        count = itertools.count(start, TICK_NS)
        return lambda: next(count)

    def _set_clock(self, now: Callable[[], int], on: Callable[[], bool]) -> None:
        real, of_day = time.clock_gettime_ns, time.CLOCK_REALTIME
        strftime, localtime = time.strftime, time.localtime
        values: dict[str, Callable[..., Any]] = {
            "time_ns": now,
            "time": lambda: now() / 1e9,
            **{name: _at(getattr(time, name), now) for name in ("localtime", "gmtime", "ctime")},
            "strftime": lambda form, at=None: strftime(form, at or localtime(now() / 1e9)),
            "clock_gettime_ns": lambda clock: now() if clock == of_day else real(clock),
            "clock_gettime": lambda clock: (now() if clock == of_day else real(clock)) / 1e9,
        }
        for name, value in values.items():
            self._replace(time, name, value, on)
        self._set_dates(now, on)

    def _set_dates(self, now: Callable[[], int], on: Callable[[], bool]) -> None:
        """Replaces the methods of `datetime` itself: it may be imported by name, and compared by type."""
        real_now, real_today, real_utcnow = datetime.now, date.today, datetime.utcnow

        def free() -> bool:
            return self._places.passes(sys._getframe(2)) or not on()

        def current(cls: type[datetime], tz: tzinfo | None = None) -> datetime:
            return real_now(tz) if free() else cls.fromtimestamp(now() / 1e9, tz)

        def today(cls: type[date]) -> date:
            return real_today() if free() else cls.fromtimestamp(now() / 1e9)

        def utcnow(cls: type[datetime]) -> datetime:
            return real_utcnow() if free() else cls.utcfromtimestamp(now() / 1e9)

        methods: dict[type, dict[str, Any]] = {
            datetime: {"now": current, "today": today, "utcnow": utcnow},
            date: {"today": today},
        }
        for cls, replaced in methods.items():
            gc.get_referents(vars(cls))[0].update({n: classmethod(f) for n, f in replaced.items()})
            ctypes.pythonapi.PyType_Modified(ctypes.py_object(cls))

    def _fix_monotonic(self) -> None:
        now = self._ticking(10**12)
        for name in ("monotonic", "perf_counter", "process_time", "thread_time"):
            self._replace(time, f"{name}_ns", now, partial(self._gives, MONOTONIC))
            self._replace(time, name, lambda: now() / 1e9, partial(self._gives, MONOTONIC))

    def _fix_random(self) -> None:
        seed = random.Random.seed

        def fixed(self: random.Random, a: Any = None, version: int = 2) -> None:
            seed(self, default if a is None else a, version)

        default = 0 if RANDOM in self._fixed else None
        random.Random.seed = fixed  # type: ignore[method-assign]
        random.seed = partial(fixed, random._inst)
        random.seed()

    def _fix_numpy(self) -> None:
        real = BIT_GENERATOR.randbits

        def fixed(bits: int) -> int:
            if not self._gives(NUMPY):
                return int(real(bits))
            return int.from_bytes(self._bytes(NUMPY, (bits + 7) // 8)) >> -bits % 8

        BIT_GENERATOR.randbits = fixed
        lazy_numpy.seed_lazily(fixed(32))

    def _fix_identifiers(self) -> None:
        for name in ("uuid1", "uuid4"):
            real = getattr(uuid, name)
            fixed = partial(self._identifier, real)
            setattr(uuid, name, fixed)

    def _identifier(self, real: Callable[..., uuid.UUID], *args: Any, **kwargs: Any) -> uuid.UUID:
        return uuid.UUID(bytes=self._bytes(UUID, 16), version=4) if self._gives(UUID) else real(*args, **kwargs)

    def _fix_entropy(self) -> None:
        urandom, getrandom = os.urandom, os.getrandom

        def fixed(size: int) -> bytes:
            frame = sys._getframe(1)  # identifiers and numpy's generators are sources by themselves
            apart = frame.f_globals.get("__name__") == "uuid" or isinstance(frame.f_locals.get("self"), ForNumpy)
            return urandom(size) if apart or not self._gives(ENTROPY) else self._bytes(ENTROPY, size)

        os.urandom = fixed
        os.getrandom = lambda size, flags=0: fixed(size) if ENTROPY in self._fixed else getrandom(size, flags)
        random._urandom = fixed  # type: ignore[attr-defined]

    def _bytes(self, source: str, size: int) -> bytes:
        """Returns the next bytes for a source: what others draw must not change them."""
        self._drawn[source] += 1
        blocks = [xxhash.xxh3_128_digest(f"{source}/{self._drawn[source]}/{k}".encode()) for k in range(size // 16 + 1)]
        return b"".join(blocks)[:size]

    def _fix_identities(self) -> None:
        def numbered(thing: object) -> int:
            if self._places.owner(sys._getframe(1)) != "own":
                return _ADDRESS_OF(thing)
            return self._number(IDENTITY, thing)

        builtins.id = numbered

    def _number(self, source: str, thing: object) -> int:
        """Returns an address for an object: where `source` is fixed by the order of the calls, else the real one. It is
        counted either way, so that nothing but the number differs between the two."""
        address, numbered = _ADDRESS_OF(thing), self._numbered[source]
        if address not in numbered:
            self._count[source] += 1
            try:
                kept: object = weakref.ref(thing, lambda _: numbered.pop(address, None))
            except TypeError:
                kept = thing  # or another object would take its address
            numbered[address] = (4096 + 16 * self._count[source], kept)
        return numbered[address][0] if self._gives(source) else address

    def number_objects(self) -> None:
        """Has objects of own classes hash and describe themselves by their number, where anything is fixed."""
        if not self._fixed:
            return
        for module in self._places.modules():
            classes: list[Any] = [each for each in vars(module).values() if isinstance(each, type)]
            for cls in classes:
                if cls.__module__ != module.__name__:
                    continue
                if cls.__hash__ is object.__hash__ and cls.__eq__ is object.__eq__:
                    cls.__hash__ = lambda thing: self._number(ADDRESSES, thing) >> 4
                if cls.__repr__ is object.__repr__:
                    cls.__repr__ = lambda thing: self._described(thing)

    def _described(self, thing: object) -> str:
        kind = type(thing)
        return f"<{kind.__module__}.{kind.__qualname__} object at {self._number(ADDRESSES, thing):#x}>"

    def _take_turns(self) -> None:
        """Has one thread run at a time: on one core, pools have one, and others are waited for where they start."""
        if THREADS in self._fixed:
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        start, passes = threading.Thread.start, self._places.passes

        def started(thread: threading.Thread) -> None:
            start(thread)
            if THREADS in self._fixed and not passes(sys._getframe(1)):
                thread.join(TURN)

        threading.Thread.start = started  # type: ignore[assignment,method-assign]
        for pool in (ThreadPoolExecutor, ThreadPool):
            pool.__init__ = self._of_one(pool.__init__)  # type: ignore[method-assign]

    def _of_one(self, make: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(make)
        def made(pool: Any, workers: int | None = None, *args: Any, **kwargs: Any) -> None:
            given = [kwargs.pop(name, None) for name in ("max_workers", "processes")]
            make(pool, 1 if THREADS in self._fixed else workers or given[0] or given[1], *args, **kwargs)

        return made

    def _fill(self, pattern: int) -> None:
        for name in ("empty", "empty_like"):
            setattr(np, name, _filled(getattr(np, name), pattern))


def _at(real: Callable[..., Any], now: Callable[[], int]) -> Callable[..., Any]:
    return lambda seconds=None: real(now() / 1e9 if seconds is None else seconds)


def _filled(make: Callable[..., Any], pattern: int) -> Callable[..., Any]:
    @functools.wraps(make)
    def filled(*args: Any, **kwargs: Any) -> Any:
        array = make(*args, **kwargs)
        if isinstance(array, np.ndarray) and not array.dtype.hasobject:
            ctypes.memset(array.ctypes.data, pattern, array.nbytes)
        return array

    return filled


def _hide(paths: Collection[str]) -> None:
    """Has nothing find files and folders: neither open them, nor list them, nor ask about them."""

    def refuse(event: str, args: tuple[Any, ...]) -> None:
        if event in ("open", "os.listdir", "os.scandir") and (path := absolute(args[0] or ".")) in paths:
            raise FileNotFoundError(2, "hidden by --why", path)

    def look(name: str, path: Any, args: Any, kwargs: Any) -> Any:
        if (asked := absolute(path)) in paths:
            raise FileNotFoundError(2, "hidden by --why", asked)
        return looking_at(name, path, args, kwargs)

    sys.addaudithook(refuse)
    look_through(look)


def changed(value: str | None) -> str:
    """Returns another value of an environment variable: another number, another word, or 7 where it has none.

    The path of a file that exists stays: what is in that file matters, and is asked for itself.
    """
    if value is None:
        return "7"
    if os.path.exists(value):
        return value
    try:
        return str(int(value) + 1)
    except ValueError:
        pass
    try:
        return repr(float(value) + 1.0)
    except ValueError:
        return f"{value}_"
