"""Operators that do not repeat, or depend on what no recording holds: one for each kind of cause."""

from __future__ import annotations

import ctypes
import os
import random
import threading
import time
import uuid
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import Param
from zoo.operators import Hard

SEEN = {"n": 0}


class Wall(Hard):
    """Emits the age of its input by the clock of the machine."""

    def work(self, x: FeatureVector) -> float:
        return (time.time() - x.stamp * 1e-9) % 1000


class Monotonic(Hard):
    """Emits the time since its last call."""

    def setup(self) -> None:
        super().setup()
        self.last = time.perf_counter()

    def work(self, x: FeatureVector) -> float:
        last, self.last = self.last, time.perf_counter()
        return self.last - last


class Compiled(Hard):
    """Has the C library read the clock."""

    def setup(self) -> None:
        super().setup()
        self.clock = ctypes.CDLL(None).clock_gettime
        self.at = (ctypes.c_long * 2)()

    def work(self, x: FeatureVector) -> float:
        self.clock(0, self.at)
        return float(self.at[1])


class Reseeded(Hard):
    """Seeds Python's generator with the entropy of the system."""

    def setup(self) -> None:
        super().setup()
        self.mine = random.Random()

    def work(self, x: FeatureVector) -> float:
        return self.mine.gauss(0, 1)


class Numpy(Hard):
    """Seeds numpy's generator with the entropy of the system."""

    def work(self, x: FeatureVector) -> float:
        np.random.seed()
        return float(np.random.normal())


class Identifier(Hard):
    """Numbers its results by random identifiers."""

    def work(self, x: FeatureVector) -> int:
        return uuid.uuid4().int % 10_007


class Bytes(Hard):
    """Draws bytes from the system."""

    def work(self, x: FeatureVector) -> int:
        return int.from_bytes(os.urandom(3))


class Hashes(Hard):
    """Takes words in the order of a set."""

    def work(self, x: FeatureVector) -> list[float]:
        return [float(word[1:]) for word in {f"w{k * 37 % 11}" for k in range(8)}]


class Identities(Hard):
    """Sorts objects by their `id()`."""

    def work(self, x: FeatureVector) -> list[int]:
        things = [bytes(size) for size in (10, 10_000, 700, 40, 3_000, 90_000, 200_000, 300)]
        return [len(thing) for thing in sorted(things, key=id)] + [id(things[5]) % 65_537]


class Thing:
    """An object in a set."""


class Addresses(Hard):
    """Takes objects in the order of a set, which is that of their addresses."""

    def work(self, x: FeatureVector) -> list[int]:
        things = {Thing(): k for k in range(40)}
        return [things[thing] for thing in set(things)]


class Threads(Hard):
    """Adds up numbers in the order in which threads bring them."""

    def work(self, x: FeatureVector) -> float:
        done: list[float] = []
        rows = np.random.default_rng(1).random(100_000)

        def add(k: int) -> None:
            np.sort(rows)
            done.append(1.0 / (k + 3))

        threads = [threading.Thread(target=add, args=(k,)) for k in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return done[0] - done[1] * done[2]


class Empty(Hard):
    """Sums up an array of which it has written the half."""

    def work(self, x: FeatureVector) -> float:
        rows = np.empty(8_000)
        rows[::2] = 1.0
        return float(np.frombuffer(rows.tobytes(), np.uint8).sum())


class FromFile(Hard):
    """Reads a gain from a file."""

    path: str = Param("", doc="file that holds a number")

    def work(self, x: FeatureVector) -> float:
        return float(Path(self.path).read_text()) * float(x.vectors[0, 0])


class FromVariable(Hard):
    """Reads a gain from the environment."""

    def work(self, x: FeatureVector) -> float:
        return float(os.environ.get("ZOO_GAIN", "1")) * float(x.vectors[0, 0])


class Writes(Hard):
    """Writes into its input."""

    def work(self, x: FeatureVector) -> Any:
        rows = x.vectors
        rows.flags.writeable = True
        rows += 1
        return rows[0]


class Leaves(Hard):
    """Counts calls in its module."""

    def work(self, x: FeatureVector) -> int:
        SEEN["n"] += 1
        return SEEN["n"]


class Two(Hard):
    """Reads the clock, and draws from the system."""

    def work(self, x: FeatureVector) -> list[float]:
        return [time.time() % 1000, float(os.urandom(1)[0])]


class ClockAndMemory(Hard):
    """Reads the clock, and memory that it has not written."""

    def work(self, x: FeatureVector) -> list[float]:
        return [time.time() % 1000, float(np.frombuffer(np.empty(900).tobytes(), np.uint8).sum())]


class Sound(Hard):
    """Reads the clock, entropy, addresses and variables, and lets none of it into its results."""

    gain: float = Param(1.0, doc="factor")

    def work(self, x: FeatureVector) -> float:
        began, stamp = time.perf_counter(), time.time()
        scratch = np.empty(100)
        scratch[:] = self.gain
        known = {id(scratch): uuid.uuid4(), id(self): os.urandom(4)}
        order = sorted({f"w{k}" for k in range(5)})
        self.log.debug("%s %s %s %s", time.perf_counter() - began, stamp, len(known), os.environ.get("HOME"))
        return float(scratch.sum()) + len(order) + float(x.vectors[0, 0])
