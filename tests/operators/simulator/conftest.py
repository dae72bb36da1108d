"""Worlds are the same for the same parameters and never change, so the tests of the simulator share them."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import pytest

from operators.simulator.worlds import make


@pytest.fixture(scope="session", autouse=True)
def shared_worlds() -> Iterator[None]:
    made = make.make_world
    make.make_world = functools.lru_cache(maxsize=16)(made)
    yield
    make.make_world = made
