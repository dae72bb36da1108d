"""A module whose sources of chance are read by compiled code, which it gives them to."""

from __future__ import annotations

import time
from collections import defaultdict


class Thing:
    """An object without a hash or a description of its own."""


def read() -> list[int]:
    """Returns numbers of things, in the order of the addresses that they were given."""
    things = [Thing() for _ in range(5)]
    times: dict[str, float] = defaultdict(time.time)
    times["now"]
    hash(things[0])
    return [things.index(thing) for thing in sorted(things, key=id)]
