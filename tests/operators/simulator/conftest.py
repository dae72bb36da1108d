"""Worlds are the same for the same parameters and never change, so the tests of the simulator share them."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import pytest

from operators.simulator import worlds


@pytest.fixture(scope="session", autouse=True)
def shared_worlds() -> Iterator[None]:
    made = worlds.make_world
    worlds.make_world = functools.lru_cache(maxsize=16)(made)
    yield
    worlds.make_world = made
