"""numpy's global generator is seeded when it is drawn from, and gives what it would have if seeded at once."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.random import mtrand

from dataflow.execution.generators import lazy_numpy
from dataflow.execution.generators.lazy_numpy import peek, seed_lazily

drawn_from_before = np.random.normal
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "beta": (1, 2),
    "binomial": (10, 0.5),
    "bytes": (5,),
    "chisquare": (2,),
    "choice": (10,),
    "dirichlet": ([1, 2],),
    "f": (1, 2),
    "gamma": (1,),
    "geometric": (0.5,),
    "hypergeometric": (3, 4, 2),
    "logseries": (0.5,),
    "multinomial": (5, [0.5, 0.5]),
    "multivariate_normal": ([0, 0], np.eye(2)),
    "negative_binomial": (3, 0.5),
    "noncentral_chisquare": (1, 2),
    "noncentral_f": (1, 2, 3),
    "pareto": (2,),
    "permutation": (10,),
    "power": (2,),
    "randint": (100,),
    "random_integers": (100,),
    "rayleigh": (1,),
    "standard_gamma": (1,),
    "standard_t": (1,),
    "triangular": (0, 1, 2),
    "vonmises": (0, 1),
    "wald": (1, 2),
    "weibull": (2,),
    "zipf": (2,),
}
METHODS = [n for n in dir(np.random.RandomState) if not n.startswith("_") and n not in ("seed", "set_state", "shuffle")]
SOME_STATE = np.random.RandomState(5).get_state()


def _method(name: str) -> Callable[[], Any]:
    return lambda: getattr(mtrand._rand, name)(*ARGUMENTS.get(name, ()))


def _shuffled() -> Any:
    cards = np.arange(20)
    np.random.shuffle(cards)
    return cards


def _kept() -> float:
    state = np.random.get_state()
    np.random.seed(1)
    np.random.set_state(state)
    return np.random.rand()


def _raw() -> Any:
    return mtrand._rand._bit_generator.random_raw(3)


USES: dict[str, Callable[[], Any]] = {name: _method(name) for name in METHODS} | {
    "shuffle": _shuffled,
    "bound before": lambda: drawn_from_before(),
    "a seed of its own": lambda: (np.random.seed(5), np.random.rand()),
    "a state of its own": lambda: (np.random.set_state(SOME_STATE), np.random.normal()),
    "state kept and put back": _kept,
    "raw numbers": _raw,
    "a Generator on it": lambda: np.random.Generator(mtrand._rand._bit_generator).random(),
    "pickled": lambda: pickle.loads(pickle.dumps(mtrand._rand)).random_sample(),
}


@pytest.fixture(autouse=True)
def _restored() -> Iterator[None]:
    state = np.random.get_state()
    yield
    np.random.set_state(state)


def plain(value: Any) -> str:
    return str(value)


@pytest.mark.parametrize("use", USES)
def test_lazy_seeding_draws_the_same_numbers(use: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        np.random.seed(7)
        np.random.normal()  # leaves a second number behind, which seeding has to forget
        np.random.seed(9)
        expected = plain(USES[use]()), np.random.normal(size=700).tolist()
        np.random.normal()

        seed_lazily(8)
        seed_lazily((5 << 32) + 9)
        assert lazy_numpy._GENERATOR.lock.pending is not None
        assert (plain(USES[use]()), np.random.normal(size=700).tolist()) == expected


def test_seed_after_a_draw_repeats_the_draws() -> None:
    drawn = []
    for _ in range(2):
        seed_lazily(3)
        drawn.append((np.random.rand(), np.random.normal()))
    assert drawn[0] == drawn[1]


def test_a_bit_generator_of_another_kind_is_left_there() -> None:
    before = mtrand.get_bit_generator()
    mtrand.set_bit_generator(np.random.MT19937(3))
    try:
        np.random.seed(9)
        expected = np.random.rand()
        seed_lazily(9)
        assert np.random.rand() == expected
        mtrand.set_bit_generator(np.random.PCG64(1))
        seed_lazily(9)
        assert type(mtrand.get_bit_generator()) is np.random.PCG64
    finally:
        mtrand.set_bit_generator(before)


def test_looking_at_the_generator_does_not_draw() -> None:
    seed_lazily(3)
    before = peek()

    assert peek() == before
    assert lazy_numpy._GENERATOR.lock.pending == 3
    np.random.rand()
    assert peek() != before
    before = peek()
    np.random.rand()
    assert peek() != before


def test_peek_detects_draws_that_return_the_generator_to_its_position() -> None:
    seed_lazily(3)
    np.random.bytes(4 * 624)
    before = peek()
    state = np.random.get_state(legacy=False)

    np.random.bytes(4 * 624)

    assert np.random.get_state(legacy=False)["state"]["pos"] == state["state"]["pos"]
    assert peek() != before
