"""Python's global generator is seeded when it is drawn from, and gives what it would have if seeded at once."""

from __future__ import annotations

import random
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from dataflow.execution.generators import lazy_random
from dataflow.execution.generators.lazy_random import peek, seed_lazily

shuffle = random.shuffle
gauss = random.gauss
set_seed = random.seed
set_state = random.setstate
get_state = random.getstate
SOME_STATE = random.Random(5).getstate()


def _shuffled(shuffle: Callable[[list[int]], None]) -> list[int]:
    cards = list(range(20))
    shuffle(cards)
    return cards


USES: dict[str, Callable[[], Any]] = {
    "random": lambda: random.random(),
    "getrandbits": lambda: random.getrandbits(70),
    "randint": lambda: random.randint(1, 10**9),
    "shuffle": lambda: _shuffled(random.shuffle),
    "shuffle, bound before": lambda: _shuffled(shuffle),
    "gauss": lambda: (random.gauss(0, 1), random.gauss(0, 1)),
    "gauss, bound before": lambda: (gauss(0, 1), gauss(0, 1)),
    "normalvariate": lambda: random.normalvariate(0, 1),
    "randbytes": lambda: random.randbytes(5),
    "sample": lambda: random.sample(range(1000), 5),
    "getstate": lambda: random.getstate(),
    "getstate, bound before": lambda: get_state(),
    "a seed of its own": lambda: (random.seed(5), random.random()),
    "a seed of its own, bound before": lambda: (set_seed("five"), random.random()),
    "a state of its own": lambda: (random.setstate(SOME_STATE), random.random()),
    "a state of its own, bound before": lambda: (set_state(SOME_STATE), gauss(0, 1)),
    "state kept and put back": lambda: (s := random.getstate(), random.seed(1), random.setstate(s), random.random())[3],
    "the generator itself": lambda: random._inst.random(),
    "a name that was taken while it was pending": lambda: _taken(),
}


def _taken() -> tuple[float, int]:
    from random import getrandbits
    from random import random as draw

    return draw(), getrandbits(9)


@pytest.fixture(autouse=True)
def _restored() -> Iterator[None]:
    state = random.getstate()
    yield
    random.setstate(state)


@pytest.fixture
def _lazy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other modules of this process may refer to the C functions, which keeps the generator from being lazy."""
    monkeypatch.setattr(lazy_random, "_REFERENCES", sys.maxsize)


@pytest.mark.usefixtures("_lazy")
@pytest.mark.parametrize("use", USES)
def test_lazy_seeding_draws_the_same_numbers(use: str) -> None:
    for seed in (0, 2**63 - 1):
        random.seed(7)
        random.gauss(0, 1)  # leaves a second number behind, which seeding has to forget
        random.seed(seed)
        expected = USES[use](), [random.random() for _ in range(700)]
        random.gauss(0, 1)

        seed_lazily(seed + 1)
        seed_lazily(seed)
        assert random._inst.__class__ is lazy_random._Pending
        assert (USES[use](), [random.random() for _ in range(700)]) == expected


@pytest.mark.usefixtures("_lazy")
def test_seed_after_a_draw_repeats_the_draws() -> None:
    drawn = []
    for _ in range(2):
        seed_lazily(3)
        drawn.append((random.random(), random.gauss(0, 1)))
    assert drawn[0] == drawn[1]


def test_generator_is_seeded_at_once_where_another_module_holds_its_c_functions() -> None:
    random.random()  # whatever was pending is no more
    held = random.random
    random.seed(3)
    expected = random.random()

    seed_lazily(3)

    assert held() == expected
    del held


@pytest.mark.usefixtures("_lazy")
def test_looking_at_the_generator_does_not_draw() -> None:
    seed_lazily(3)
    before = peek()

    assert peek() == before
    assert random._inst.__class__ is lazy_random._Pending
    random.random()
    assert peek() != before
    before = peek()
    random.random()
    assert peek() != before
