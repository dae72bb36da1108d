"""Worlds are the same for the same parameters and never change, so the tests of the simulator share them."""

from __future__ import annotations

import functools
from collections.abc import Iterator

import pytest

from operators.sources import simulated_robot


@pytest.fixture(scope="session", autouse=True)
def shared_worlds() -> Iterator[None]:
    made = simulated_robot.make_world
    simulated_robot.make_world = functools.lru_cache(maxsize=16)(made)
    yield
    simulated_robot.make_world = made
