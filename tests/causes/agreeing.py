"""A module whose results are those of other runs, as a rule, though it reads sources of chance."""

from __future__ import annotations

import logging
import random
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Thread

import numpy as np


class Thing:
    """An object with the hash of its address."""


def read() -> dict[str, object]:
    """Returns results of each source over forty calls."""
    return {
        "wall": [_apart(time.time) for _ in range(40)],
        "monotonic": [_apart(time.monotonic) for _ in range(40)],
        "timer": [_apart(time.perf_counter) for _ in range(40)],
        "log": [_apart(lambda: logging.makeLogRecord({}).created) for _ in range(40)],
        "urandom": [random.SystemRandom().random() < 1e-4 for _ in range(40)],
        "random": [random.Random().random() < 1 / 300 for _ in range(40)],
        "numpy": [bool(np.random.default_rng().random() < 1 / 300) for _ in range(40)],
        "id": _ranks([id(thing) for thing in [Thing() for _ in range(5)]]),
        "hash": _ranks([hash(thing) for thing in [Thing() for _ in range(5)]]),
        "threads": _finished(),
        "pool": _pooled(),
    }


def _apart(now: object) -> float:
    """Returns the time between two readings of a clock, rounded to 10 ms."""
    assert callable(now)
    began = now()
    return round(float(now() - began), 2)


def _ranks(numbers: list[int]) -> list[int]:
    return [sorted(numbers).index(number) for number in numbers]


def _finished() -> list[int]:
    done: list[int] = []
    threads = [Thread(target=done.append, args=(k,)) for k in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return done


def _pooled() -> list[int]:
    done: list[int] = []
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(partial(_add, done), range(3)))
    return done


def _add(done: list[int], number: int) -> None:
    done.append(number)
