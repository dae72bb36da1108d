"""Seeds Python's global generator at the first draw, not before: seeding costs more than a small firing.

Until then the generator has another class, whose methods seed it first. Its methods written in Python, also those
already bound elsewhere (`from random import shuffle`), go through the overridden ones. `random.random` and
`random.getrandbits` are in C and bound when `random` is imported: their names in the module are replaced meanwhile, and
where other modules refer to them (`from random import random`), as their reference counts show, the generator is
seeded at once, as it would be without this module. Draws are the same either way.
"""

from __future__ import annotations

import _random
import random
import sys
from typing import Any, SupportsInt

_GENERATOR = random._inst
_BOUND = {"random": random.random, "getrandbits": random.getrandbits}
_REFERENCES = 4
"""Those to a bound method of `random`, of `_BOUND`, and of the loop and the call that count them."""


class _State:
    """Holds what is pending, and how often the generator was seeded after all."""

    __slots__ = ("seed", "settled")

    def __init__(self) -> None:
        self.seed: SupportsInt = 0
        self.settled = 0


_STATE = _State()


def seed_lazily(seed: SupportsInt) -> None:
    """Seeds the global generator, as `random.seed(seed)` does, at the next access to it."""
    if _GENERATOR.__class__ is _Pending:
        _STATE.seed = seed
        return
    if any(sys.getrefcount(method) > _REFERENCES for method in _BOUND.values()):
        random.seed(int(seed))
        return
    _STATE.seed = seed
    _change_class(_Pending)
    random.__dict__.update(_SETTLING)


def _change_class(to: type[random.Random]) -> None:
    object.__setattr__(_GENERATOR, "__class__", to)


def peek() -> tuple[object, ...]:
    """Returns a value that differs after a draw, and does not seed the generator. While a seed is pending the value is
    a number, since a draw settles the seed; copying the state takes 10 µs."""
    if _GENERATOR.__class__ is _Pending:
        return (_STATE.settled,)
    return _STATE.settled, _random.Random.getstate(_GENERATOR)


Held = tuple[bool, Any]
"""True and the seed that is pending, or False and the state."""


def held() -> Held:
    """Returns what `give_back` brings back: what is pending, or the state; does not seed the generator."""
    if _GENERATOR.__class__ is _Pending:
        return True, _STATE.seed
    return False, random.getstate()


def give_back(held: Held) -> None:
    """Makes the generator what it was when it was `held`."""
    pending, value = held
    if not pending:
        random.setstate(value)
    elif _GENERATOR.__class__ is not _Pending:
        seed_lazily(value)


def _restore() -> random.Random:
    """Makes the generator an ordinary one again, in the state that it has."""
    if _GENERATOR.__class__ is _Pending:
        _STATE.settled += 1
        _change_class(random.Random)
        random.__dict__.update(_BOUND)
    return _GENERATOR


def _settle() -> random.Random:
    """Seeds the generator with what is pending, if it still is."""
    if _GENERATOR.__class__ is _Pending:
        _restore().seed(int(_STATE.seed))
    return _GENERATOR


class _Pending(random.Random):
    """The class of the global generator while its seed is pending.

    `random.seed`, `getstate`, `setstate` and `gauss` of the module are bound to functions of the class above. They
    look at `VERSION` or `gauss_next` before they look at the state, or set `gauss_next` when they replace it.
    """

    def random(self) -> float:
        return _settle().random()

    def getrandbits(self, k: int, /) -> int:
        return _settle().getrandbits(k)

    @property
    def VERSION(self) -> int:  # type: ignore[override]
        return _settle().VERSION

    @property
    def gauss_next(self) -> Any:
        return _settle().gauss_next  # type: ignore[attr-defined]

    @gauss_next.setter
    def gauss_next(self, value: Any) -> None:
        _restore().gauss_next = value  # type: ignore[attr-defined]


def _settled_random() -> float:
    return _settle().random()


def _settled_getrandbits(k: int, /) -> int:
    return _settle().getrandbits(k)


_SETTLING = {"random": _settled_random, "getrandbits": _settled_getrandbits}
