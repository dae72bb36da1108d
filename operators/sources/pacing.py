"""Stamps of frames without stamps."""

from __future__ import annotations

from fractions import Fraction


def frame_stamp(index: int, rate: float, first_stamp: int) -> int:
    """first_stamp + index / rate in whole nanoseconds, rounded down once: no error builds up over a long sequence.

    The rate counts as the decimal number it is written as, so 29.97 means 2997/100.
    """
    return first_stamp + int(index * Fraction(10**9) / Fraction(str(rate)))
