"""Schedule of the sensors' measurements: each on its own grid of whole nanoseconds, merged into one sequence of
stamps."""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from operators.sources.pacing import frame_stamp


@dataclass(frozen=True)
class Tick:
    """Measurement number `index` of a sensor."""

    sensor: str
    index: int
    stamp: int


def ticks(sensor: str, rate: float, first_stamp: int, end_stamp: int) -> Iterator[Tick]:
    """The ticks of one sensor from its first stamp up to, not including, the end."""
    index = 0
    while rate > 0:
        stamp = frame_stamp(index, rate, first_stamp)
        if stamp >= end_stamp:
            return
        yield Tick(sensor, index, stamp)
        index += 1


def ticks_at(sensor: str, stamps: Sequence[int], end_stamp: int) -> Iterator[Tick]:
    """Ticks at given, rising stamps before the end."""
    return (Tick(sensor, k, stamp) for k, stamp in enumerate(stamps) if stamp < end_stamp)


def merged(streams: Mapping[str, Iterator[Tick]]) -> Iterator[tuple[int, list[Tick]]]:
    """(stamp, the ticks at it): stamps strictly increase, ticks of one stamp keep the order of the mapping."""
    order = {name: k for k, name in enumerate(streams)}
    ahead = [
        (tick.stamp, order[name], tick) for name, stream in streams.items() for tick in [next(stream, None)] if tick
    ]
    heapq.heapify(ahead)
    while ahead:
        stamp, together = ahead[0][0], []
        while ahead and ahead[0][0] == stamp:
            _, k, tick = heapq.heappop(ahead)
            together.append(tick)
            following = next(streams[tick.sensor], None)
            if following is not None:
                heapq.heappush(ahead, (following.stamp, k, following))
        yield stamp, together


def generator(seed: int, sensor: str, index: int) -> np.random.Generator:
    """The random numbers of one measurement: they depend on nothing that was measured before or beside it."""
    return np.random.default_rng([seed, zlib.crc32(sensor.encode()), index])
