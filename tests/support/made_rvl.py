"""RVL as its paper has it, one pixel after the other (Wilson 2017)."""

from __future__ import annotations

import numpy as np


def packed_rvl(pixels: np.ndarray) -> bytes:
    groups: list[int] = []

    def number(value: int) -> None:
        while True:
            groups.append((value & 7) | (8 if value >> 3 else 0))
            value >>= 3
            if not value:
                return

    at, previous, values = 0, 0, [int(p) for p in pixels.ravel()]
    while at < len(values):
        zeros = others = 0
        while at + zeros < len(values) and not values[at + zeros]:
            zeros += 1
        at += zeros
        while at + others < len(values) and values[at + others]:
            others += 1
        number(zeros)
        number(others)
        for value in values[at : at + others]:
            delta, previous = value - previous, value
            number(delta << 1 if delta >= 0 else (-delta << 1) - 1)
        at += others
    groups += [0] * (-len(groups) % 8)
    words = [sum(group << (28 - 4 * k) for k, group in enumerate(groups[i : i + 8])) for i in range(0, len(groups), 8)]
    return np.array(words, "<u4").tobytes()
