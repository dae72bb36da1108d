"""Operators that are hard to re-execute: each is a habit that real code has."""

from __future__ import annotations

import asyncio
import decimal
import itertools
import multiprocessing
import os
import random
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import gauss, getrandbits
from random import random as drawn
from typing import Any

import numpy as np
from numpy.random import normal

from dataflow.messages import FeatureVector, Message
from dataflow.operator import Context, In, Operator, Out, Param, Source

CALLS = {"n": 0}
STEPS = 60


def numbers(stamp: int, *values: float) -> FeatureVector:
    return FeatureVector(stamp=stamp, vectors=np.array([values], np.float64), model="zoo")


class Steps(Source):
    """Small matrices at 50 Hz."""

    out: Out[FeatureVector]
    steps: int = Param(STEPS, ge=1, doc="messages")

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(self.steps):
            rows = np.array([[k + 2, 1], [1, 3]], np.float32)
            yield {"out": FeatureVector(stamp=10**18 + k * 20_000_000, vectors=rows, model="zoo")}


class Hard(Operator):
    """Emits the numbers that `work` gives for each input. Does nothing hard itself."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        self.calls = 0

    def process(self, x: FeatureVector) -> FeatureVector:
        self.calls += 1
        return numbers(x.stamp, self.calls, *np.atleast_1d(self.work(x)))

    def work(self, x: FeatureVector) -> Any:
        return 2 * x.vectors[0, 0]


class KeptGenerator(Hard):
    """Keeps a generator, which draws, over its firings."""

    def setup(self) -> None:
        super().setup()
        self.running = self.run()
        next(self.running)

    def run(self) -> Generator[float, FeatureVector, None]:
        total = 0.0
        while True:
            x = yield total
            total += float(x.vectors[0, 0]) * random.random()

    def work(self, x: FeatureVector) -> float:
        return self.running.send(x)


class Pool(Hard):
    """Divides its work among threads and takes the results in order."""

    def setup(self) -> None:
        super().setup()
        self.pool = ThreadPoolExecutor(3)

    def work(self, x: FeatureVector) -> list[float]:
        return list(self.pool.map(lambda k: k * float(x.vectors[0, 0]), range(6)))

    def close(self) -> None:
        self.pool.shutdown()


class Race(Hard):
    """Takes the results of threads in the order in which they finish, which two runs hardly ever share by chance."""

    def work(self, x: FeatureVector) -> list[int]:
        done: list[int] = []

        def finish(k: int) -> None:
            time.sleep(os.urandom(1)[0] / 100_000)
            done.append(k)

        threads = [threading.Thread(target=finish, args=(k,)) for k in range(12)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return done


class Loop(Hard):
    """Runs an event loop of tasks that wait for each other."""

    def work(self, x: FeatureVector) -> list[float]:
        async def one(k: int) -> float:
            await asyncio.sleep(0.0002 * (k % 2))
            return k * float(x.vectors[0, 0])

        async def every() -> list[float]:
            return await asyncio.gather(*map(one, range(4)))

        return asyncio.run(every())


class Views(Hard):
    """Keeps views of its inputs, and changes copies of them."""

    def setup(self) -> None:
        super().setup()
        self.views: list[Any] = []

    def work(self, x: FeatureVector) -> float:
        self.views = [*self.views[-20:], x.vectors[0]]
        changed = self.views[0].copy()
        changed += self.calls
        return float(changed.sum() + sum(view.sum() for view in self.views))


class Draws(Hard):
    """Draws from all global generators, by names that were bound when it was imported, too."""

    def work(self, x: FeatureVector) -> list[float]:
        return [drawn(), getrandbits(20), gauss(0, 1), normal(), *np.random.permutation(3), self.rng.normal()]


class States(Hard):
    """Takes the states of the global generators with it to the next firing."""

    numpy: Any
    python: Any

    def work(self, x: FeatureVector) -> list[float]:
        if self.calls > 1:
            np.random.set_state(self.numpy)
            random.setstate(self.python)
        found = [np.random.random(), random.random()]
        self.numpy, self.python = np.random.get_state(), random.getstate()
        return found


class LazyLibrary(Hard):
    """Loads OpenCV in its first firing, and draws from its generator."""

    def work(self, x: FeatureVector) -> Any:
        import cv2

        found = np.zeros((1, 4), np.float32)
        cv2.randu(found, 0, 1)  # type: ignore[call-overload]
        return found[0]


class LazyModule(Hard):
    """Loads a module in its first firing that seeds the global generators."""

    def work(self, x: FeatureVector) -> list[float]:
        import zoo.drawing  # noqa: F401

        return [random.random(), np.random.random()]


class Command(Hard):
    """Runs a command, now and then."""

    def work(self, x: FeatureVector) -> int:
        if self.calls % 20 != 1:
            return 0
        return int(subprocess.run(["echo", str(self.calls)], capture_output=True, check=True).stdout)


class Fork(Hard):
    """Forks, and reads what the child has computed."""

    def work(self, x: FeatureVector) -> int:
        if self.calls % 10 != 1:
            return 0
        read, write = os.pipe()
        child = os.fork()
        if not child:
            os.write(write, str(self.calls).encode())
            os._exit(0)
        os.close(write)
        with os.fdopen(read) as answer:
            os.waitpid(child, 0)
            return int(answer.read())


class Files(Hard):
    """Keeps its state in a file of a folder that it makes."""

    def setup(self) -> None:
        super().setup()
        self.folder = tempfile.TemporaryDirectory()

    def work(self, x: FeatureVector) -> int:
        file = Path(self.folder.name) / "lines"
        with file.open("a") as lines:
            lines.write(f"{self.calls}\n")
        return len(file.read_text())

    def close(self) -> None:
        self.folder.cleanup()


class Large(Hard):
    """Keeps 40 MB, and gives them as its state."""

    def setup(self) -> None:
        super().setup()
        self.state = np.zeros(5_000_000)

    def work(self, x: FeatureVector) -> float:
        self.state[self.calls] = x.vectors[0, 0]
        return float(self.state[:100].sum())

    def snapshot(self) -> Mapping[str, Any]:
        return {"calls": self.calls, "state": self.state}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.calls, self.state = state["calls"], state["state"]


class FailsToClose(Hard):
    """Raises in `close()`."""

    def close(self) -> None:
        raise RuntimeError("it does not close")


class OddTimer(Operator, every="37ms"):
    """Fires on messages and on a timer that never meets them."""

    x: In[FeatureVector]
    out: Out[FeatureVector]

    def setup(self) -> None:
        self.calls = 0

    def process(self, x: FeatureVector | None, context: Context) -> FeatureVector:
        self.calls += 1
        return numbers(context.stamp, self.calls, context.tick, random.random())


class Decimals(Hard):
    """Sets the precision of its thread's decimal numbers."""

    def work(self, x: FeatureVector) -> float:
        decimal.getcontext().prec = 5 + self.calls % 3
        return float(decimal.Decimal(1) / decimal.Decimal(7))


class Sets(Hard):
    """Goes by the order of a set of strings, and by hashes."""

    def work(self, x: FeatureVector) -> list[float]:
        words = {f"k{k * 7919 % 101}" for k in range(self.calls)}
        return [hash("".join(words)) % 10_007, hash((1, "x")) % 10_007]


class Finalizers(Hard):
    """Counts in a finalizer."""

    def setup(self) -> None:
        super().setup()
        self.ended = itertools.count()

    def work(self, x: FeatureVector) -> int:
        class Thing:
            pass

        thing = Thing()
        weakref.finalize(thing, next, self.ended)
        del thing
        return next(self.ended)


class Bits(Hard):
    """Emits NaNs with a payload, and minus zero."""

    def work(self, x: FeatureVector) -> Any:
        return np.array([0x7FF8000000000001, 0xFFF8000000012345, 1 << 63], np.uint64).view(np.float64)


class Clock(Hard):
    """Reads the clock."""

    def work(self, x: FeatureVector) -> float:
        return time.time() % 1000


class LateClock(Hard):
    """Reads the clock, in its fifth firing only."""

    def work(self, x: FeatureVector) -> float:
        return time.time() % 1000 if self.calls == 5 else 0.0


class Entropy(Hard):
    """Draws from the generator of the system."""

    def work(self, x: FeatureVector) -> float:
        return random.SystemRandom().random()


class OwnGenerator(Hard):
    """Makes a generator without a seed."""

    def setup(self) -> None:
        super().setup()
        self.generator = np.random.default_rng()

    def work(self, x: FeatureVector) -> float:
        return float(self.generator.normal())


class Sometimes(Hard):
    """Emits by chance."""

    def process(self, x: FeatureVector) -> FeatureVector | None:  # type: ignore[override]
        return super().process(x) if os.urandom(1)[0] & 1 else None


class Stamps(Hard):
    """Stamps its messages by chance."""

    def process(self, x: FeatureVector) -> FeatureVector:
        return super().process(x).replace(stamp=x.stamp + os.urandom(2)[0] % 256)


class ZeroSigns(Hard):
    """Emits zeros whose signs are by chance."""

    def work(self, x: FeatureVector) -> list[float]:
        return [0.0 if byte & 1 else -0.0 for byte in os.urandom(8)]


class Sums(Hard):
    """Sums up with the clock: its calls repeat, what it says at the end does not."""

    def summary(self) -> Mapping[str, Any]:
        return {"at": time.time()}


class ClockedState(Hard):
    """Has the clock in its state, which nothing reads."""

    def snapshot(self) -> Mapping[str, Any]:
        return {"calls": self.calls, "at": time.time()}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.calls = state["calls"]


class LastWord(Hard):
    """Emits the clock at the end."""

    def process(self, x: FeatureVector) -> FeatureVector:
        self.last = x.stamp
        return super().process(x)

    def finish(self) -> FeatureVector:
        return numbers(self.last + 10**9, time.time() % 1000)


class Workers(Hard):
    """Divides its work among processes, now and then."""

    def work(self, x: FeatureVector) -> float:
        if self.calls % 40 != 1:
            return 0.0
        with multiprocessing.get_context("fork").Pool(2) as pool:
            return float(sum(pool.map(abs, [-self.calls, 2])))


class Process(Hard):
    """Emits the number of its process."""

    def work(self, x: FeatureVector) -> int:
        return os.getpid()


class Background(Hard):
    """Has a thread that goes on while no call is under way."""

    def setup(self) -> None:
        super().setup()
        self.count, self.over = 0, threading.Event()
        threading.Thread(target=self.go_on, daemon=True).start()

    def go_on(self) -> None:
        while not self.over.wait(0.0003):
            self.count += 1

    def work(self, x: FeatureVector) -> int:
        return self.count

    def close(self) -> None:
        self.over.set()


class Count(Hard):
    """Counts in its module."""

    def work(self, x: FeatureVector) -> int:
        CALLS["n"] += 1
        return CALLS["n"]


class Strict(Hard):
    """Has numpy raise, in the whole process."""

    def setup(self) -> None:
        super().setup()
        np.seterr(all="raise")


class Divide(Hard):
    """Divides by zero, and minds what numpy makes of it."""

    def work(self, x: FeatureVector) -> float:
        try:
            return float((1 / (0 * x.vectors[0, :1]))[0])
        except FloatingPointError:
            return -1.0


class Overwrite(Hard):
    """Lets LAPACK work in place on its input, behind the first `since` calls."""

    since: int = Param(0, ge=0, doc="calls in which it does not")

    def work(self, x: FeatureVector) -> Any:
        from scipy.linalg import inv

        return inv(x.vectors.T, overwrite_a=self.calls > self.since)[0]


class KeepsEmitted(Hard):
    """Writes into the message that it emitted before."""

    def setup(self) -> None:
        super().setup()
        self.emitted: FeatureVector | None = None

    def process(self, x: FeatureVector) -> FeatureVector:
        if self.emitted is not None:
            self.emitted.vectors.flags.writeable = True
            self.emitted.vectors[:] = -5
        self.emitted = super().process(x)
        return self.emitted


class Before(Hard):
    """Adds the input before to each input."""

    last: FeatureVector

    def work(self, x: FeatureVector) -> float:
        before = self.last if self.calls > 1 else x
        self.last = x
        return float(x.vectors[0, 0] + before.vectors[0, 0])
