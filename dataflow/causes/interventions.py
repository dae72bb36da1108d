"""Fixes sources of chance in this process, or changes what they give: before any code of an operator is imported.

A fixed source gives the same in every process: clocks go on by a millisecond a call, entropy comes from a counter,
`id()` numbers the objects that it is asked for, fresh memory has one pattern. What a changed source gives shows where
two real runs agree by chance: clocks go on by steps from a microsecond to 0.3 s, as those of a loaded machine may;
random numbers begin with very small or large ones; numbers of objects fall; threads begin late in turn.
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
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import thread as pools
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
from dataflow.causes.traps import BIT_GENERATOR, NumpyEntropy, absolute, look_through, looking_at
from dataflow.execution.generators import lazy_numpy

TICK_NS = 1_000_000
TURN = 0.2
"""Seconds for which a thread is waited for where it starts."""
STEP_NS, STEPS = 1_000, 300_000
"""The least step of an uneven clock, and how many times that the largest is."""
SCARCE = 1 / 256
"""The part of all numbers that are very small, or very large."""
HIGHEST = 1 << 45
"""The number from which those of objects fall, if they are changed."""
DELAYS = (0.03, 0.0, 0.015)
"""Seconds by which threads begin later, in turn."""
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
        self._varied: frozenset[str] = frozenset()
        self._numbered: dict[str, dict[int, tuple[int, object]]] = {IDENTITY: {}, ADDRESSES: {}}
        self._count = Counter[str]()
        self.given: set[str] = set()
        """Fixed and changed sources that gave something to code that is not the engine's or the standard library's."""
        self._drawn = Counter[str]()

    def fix(self, sources: Collection[str]) -> None:
        """Makes sources give the same in every process; the others give their real values."""
        self._fixed = frozenset(sources)
        NumpyEntropy.install()
        for install in self._installers().values():
            install()
        self._replace(os, "getpid", lambda: 4242, partial(self._gives, PROCESS))
        self._fill(FILL if HEAP in self._fixed else OTHER_FILL)
        self.given.clear()

    def vary(self, sources: Collection[str]) -> None:
        """Makes sources give something else than they do here, or than where they are fixed."""
        self._varied = frozenset(sources)
        if not self._fixed:
            NumpyEntropy.install()
            for source, install in self._installers().items():
                if source in self._varied:
                    install()
        hidden = {name_of(source) for source in sources if kind_of(source) in (FILE, FOLDER)}
        if hidden:
            _hide(hidden)
        for source in sources:
            if kind_of(source) == VARIABLE:
                os.environ[name_of(source)] = changed(os.environ.get(name_of(source)))
        if WORKING in sources:
            for name, value in (("getcwd", HERE), ("getcwdb", HERE.encode())):
                setattr(os, name, self._for_own(getattr(os, name), value))
        if HEAP in sources and not self._fixed:
            self._fill(OTHER_FILL)
        self.given.clear()

    def _installers(self) -> dict[str, Callable[[], None]]:
        """Returns by source what replaces its functions."""
        return {
            WALL: self._fix_wall,
            MONOTONIC: self._fix_monotonic,
            RANDOM: self._fix_random,
            NUMPY: self._fix_numpy,
            UUID: self._fix_identifiers,
            ENTROPY: self._fix_entropy,
            IDENTITY: self._fix_identities,
            THREADS: self._take_turns,
        }

    def _gives(self, source: str) -> bool:
        """Returns whether a source is fixed or changed; it is asked for one now."""
        gives = source in self._fixed or source in self._varied
        if gives:
            self.given.add(source)
        return gives

    def _replace(
        self,
        module: Any,
        name: str,
        value: Callable[..., Any],
        on: Callable[[], bool],
        passes: Callable[[FrameType], bool] | None = None,
    ) -> None:
        """Has all code but that which `passes` (by default the engine and the standard library) get `value` from a
        function, while it is `on`."""
        real, through = getattr(module, name), passes or self._places.passes

        @functools.wraps(real)
        def replaced(*args: Any, **kwargs: Any) -> Any:
            return (real if through(sys._getframe(1)) or not on() else value)(*args, **kwargs)

        setattr(module, name, replaced)

    def _for_own(self, real: Callable[[], Any], value: Any) -> Callable[[], Any]:
        """Gives `value` where own code asks, itself or by the standard library."""

        return lambda: value if self._places.asked_by(sys._getframe(1)) == "own" else real()

    def _clock(self, source: str, start: int, real: Callable[[], int]) -> Callable[[], int]:
        """Returns a clock (ns) that goes on by `TICK_NS` a call, or, if changed, like `real` and by uneven steps."""
        ticks, steps = itertools.count(start, TICK_NS), itertools.accumulate(map(_step, itertools.count()))
        return lambda: real() + next(steps) if source in self._varied else next(ticks)

    def _fix_wall(self) -> None:
        real = time.time_ns
        self._set_clock(self._clock(WALL, self._began, lambda: real() + LATER_NS), partial(self._gives, WALL))

    def _of_engine(self, frame: FrameType) -> bool:
        """Returns whether the engine asks for the time of day. The standard library needs none for itself: it waits by
        the monotonic clock."""
        return self._places.asked_by(frame) == "engine"

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
            self._replace(time, name, value, on, self._of_engine)
        self._set_dates(now, on)

    def _set_dates(self, now: Callable[[], int], on: Callable[[], bool]) -> None:
        """Replaces the methods of `datetime` itself: it may be imported by name, and compared by type."""
        real_now, real_today, real_utcnow = datetime.now, date.today, datetime.utcnow

        def free() -> bool:
            return self._of_engine(sys._getframe(2)) or not on()

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
        now = self._clock(MONOTONIC, 10**12, time.monotonic_ns)
        for name in ("monotonic", "perf_counter", "process_time", "thread_time"):
            self._replace(time, f"{name}_ns", now, partial(self._gives, MONOTONIC))
            self._replace(time, name, lambda: now() / 1e9, partial(self._gives, MONOTONIC))

    def _fix_random(self) -> None:
        seed, extreme = random.Random.seed, _extreme(lambda given: random.Random(given).random())

        def fixed(self: random.Random, a: Any = None, version: int = 2) -> None:
            seed(self, default() if a is None else a, version)

        def default() -> int | None:
            if not self._gives(RANDOM):
                return None
            return next(extreme) if RANDOM in self._varied else 0

        random.Random.seed = fixed  # type: ignore[method-assign]
        random.seed = partial(fixed, random._inst)
        random.seed()

    def _fix_numpy(self) -> None:
        real, extreme = BIT_GENERATOR.randbits, _extreme(lambda given: np.random.default_rng(given).random())

        def fixed(bits: int) -> int:
            if not self._gives(NUMPY):
                return int(real(bits))
            if NUMPY in self._varied:
                return next(extreme)
            return int.from_bytes(self._bytes(NUMPY, (bits + 7) // 8)) >> -bits % 8

        BIT_GENERATOR.randbits = fixed
        lazy_numpy.seed_lazily(fixed(32))

    def _fix_identifiers(self) -> None:
        for name in ("uuid1", "uuid4"):
            setattr(uuid, name, partial(self._identifier, getattr(uuid, name)))

    def _identifier(self, real: Callable[..., uuid.UUID], *args: Any, **kwargs: Any) -> uuid.UUID:
        return uuid.UUID(bytes=self._bytes(UUID, 16), version=4) if self._gives(UUID) else real(*args, **kwargs)

    def _fix_entropy(self) -> None:
        urandom, getrandom = os.urandom, os.getrandom

        def fixed(size: int) -> bytes:
            frame = sys._getframe(1)  # identifiers and numpy's generators are sources by themselves
            apart = frame.f_globals.get("__name__") == "uuid" or isinstance(frame.f_locals.get("self"), NumpyEntropy)
            return urandom(size) if apart or not self._gives(ENTROPY) else self._bytes(ENTROPY, size)

        os.urandom = fixed
        os.getrandom = lambda size, flags=0: (
            fixed(size) if ENTROPY in self._fixed | self._varied else getrandom(size, flags)
        )
        random._urandom = fixed  # type: ignore[attr-defined]

    def _bytes(self, source: str, size: int) -> bytes:
        """Returns the next bytes for a source: what others draw must not change them."""
        self._drawn[source] += 1
        name = f"{source}/{self._drawn[source]}{'/changed' if source in self._varied else ''}"
        blocks = [xxhash.xxh3_128_digest(f"{name}/{k}".encode()) for k in range(size // 16 + 1)]
        made = b"".join(blocks)[:size]
        if source not in self._varied or size < 4:
            return made
        edge = 2 if size > 5 else 1  # the rest differs from draw to draw: names that are drawn must
        first = (made[:edge], bytes(edge), made[:edge], b"\xff" * edge)[self._drawn[source] % 4]
        return first + made[edge:]

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
            apart = 16 * self._count[source]
            numbered[address] = (HIGHEST - apart if source in self._varied else 4096 + apart, kept)
        return numbered[address][0] if self._gives(source) else address

    def number_objects(self) -> None:
        """Has objects of own classes hash and describe themselves by their number, where anything is fixed."""
        if not self._fixed and ADDRESSES not in self._varied:
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
        """Has one thread run at a time: on one core, pools have one, and others are waited for where they start. If
        changed, threads and the tasks of pools begin late, in turn."""
        if THREADS in self._fixed:
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        start, passes, delays = threading.Thread.start, self._places.passes, itertools.cycle(DELAYS)

        def late(run: Callable[..., None], *args: Any) -> None:
            time.sleep(next(delays))
            run(*args)

        def started(thread: threading.Thread) -> None:
            frame = sys._getframe(1)
            if THREADS in self._varied and self._places.asked_by(frame) != "engine" and self._gives(THREADS):
                thread.run = partial(late, thread.run)  # type: ignore[method-assign]
            start(thread)
            if THREADS in self._fixed and not passes(frame):
                thread.join(TURN)

        threading.Thread.start = started  # type: ignore[assignment,method-assign]
        if THREADS in self._varied:
            run = pools._WorkItem.run
            pools._WorkItem.run = lambda item: late(run, item)  # type: ignore[assignment,method-assign]
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


def _step(number: int) -> int:
    """Returns a step of an uneven clock (ns): small ones are as many as large ones, by their logarithm."""
    part: float = xxhash.xxh32_intdigest(str(number).encode()) / (1 << 32)
    return int(STEP_NS * STEPS**part)


def _extreme(draw: Callable[[int], float]) -> Iterator[int]:
    """Returns seeds with which the first number drawn from 0 to 1 is very small or very large."""
    return filter(lambda seed: not SCARCE < draw(seed) < 1 - SCARCE, itertools.count())


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
