"""Seeds numpy's global generator at the first draw, not before: seeding costs as much as a small firing.

`numpy.random` draws under the lock of its bit generator. The one that is put in here is numpy's own, with a lock that
seeds it first where a seed is pending; so whatever refers to the global generator, and however it was imported, draws
the same as if it had been seeded at once. The class has the name of numpy's, which `numpy.random.get_state` asks for.
"""

from __future__ import annotations

import ctypes
import threading
from types import TracebackType
from typing import Any, SupportsInt

import numpy as np
from numpy.random import mtrand

_STATE: Any = np.random.MT19937.state


class _SeedingLock:
    """A lock that seeds the global generator when it is taken, if a seed is pending."""

    def __init__(self) -> None:
        self.pending: SupportsInt | None = None
        self.settled = 0
        """The number of draws so far."""
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()
        if self.pending is not None:
            self.settle()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._lock.release()

    def settle(self) -> None:
        """Seeds the generator with what is pending, if anything is."""
        with self._lock:
            seed, self.pending = self.pending, None
            if seed is not None:
                self.settled += 1
                mtrand._rand.seed(int(seed) & 0xFFFFFFFF)


class MT19937(np.random.MT19937):
    """numpy's bit generator, whose state is asked for, replaced and drawn from as one that is seeded."""

    lock: Any = _SeedingLock()

    @property
    def state(self) -> Any:
        self.lock.settle()
        return _STATE.__get__(self)

    @state.setter
    def state(self, value: Any) -> None:
        self.lock.pending = None
        _STATE.__set__(self, value)

    def random_raw(self, size: Any = None, output: Any = True) -> Any:
        self.lock.settle()
        return super().random_raw(size, output)


_GENERATOR = MT19937(0)
_LOCK: _SeedingLock = MT19937.lock
_STATE_WORDS = 624
_WORDS = (ctypes.c_uint32 * (_STATE_WORDS + 1)).from_address(_GENERATOR.ctypes.state_address)
"""The state where numpy keeps it: the words that are drawn, and how many of them have been."""


def seed_lazily(seed: SupportsInt) -> None:
    """Seeds the global generator, as `numpy.random.seed` does, with the low 32 bits of `seed`, at the next access
    to it."""
    if mtrand._rand._bit_generator is _GENERATOR:
        _LOCK.pending = seed
    elif type(mtrand._rand._bit_generator) is np.random.MT19937:
        mtrand.set_bit_generator(_GENERATOR)
        _LOCK.pending = seed
    else:
        np.random.seed(int(seed) & 0xFFFFFFFF)


Held = tuple[bool, Any]
"""True and the seed that is pending, or False and the state."""


def held() -> Held:
    """Returns what `give_back` brings back: what is pending, or the state; does not seed the generator."""
    if mtrand._rand._bit_generator is _GENERATOR and _LOCK.pending is not None:
        return True, _LOCK.pending
    return False, (mtrand._rand._bit_generator, np.random.get_state(legacy=False))


def give_back(held: Held) -> None:
    """Makes the generator what it was when it was `held`."""
    pending, value = held
    if pending:
        seed_lazily(value)
        return
    generator, state = value
    if mtrand._rand._bit_generator is not generator:
        mtrand.set_bit_generator(generator)
    np.random.set_state(state)


def peek() -> tuple[object, ...]:
    """Returns a value that differs after a draw, and does not seed the generator. While a seed is pending the value is
    a number, since a draw settles the seed; copying the state takes 30 µs."""
    settled = _LOCK.settled
    if mtrand._rand._bit_generator is _GENERATOR:
        if _LOCK.pending is not None:
            return (settled,)
        return settled, _WORDS[0], _WORDS[_STATE_WORDS]  # all words are made anew once all have been drawn
    state: Any = np.random.get_state(legacy=False)
    return settled, state["state"]["key"].tobytes(), state["state"]["pos"]
