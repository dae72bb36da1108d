"""Stamps, durations and the two ends of the time axis.

A *stamp* is event time: integer nanoseconds since the Unix epoch. A *frontier* is a promise on a stream: no
later message has a stamp at or below it. Both are plain `int`, because they are compared millions of times.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from typing import Final

NEVER: Final = -(2**63)
"""Frontier of a stream about which nothing has been promised yet."""

FOREVER: Final = 2**63 - 1
"""Frontier of a stream that has ended."""

NANOSECONDS: Final[dict[str, int]] = {
    "ns": 1,
    "us": 10**3,
    "ms": 10**6,
    "s": 10**9,
    "min": 60 * 10**9,
    "h": 3600 * 10**9,
}

_DURATION = re.compile(r"\s*(-?)(\d+(?:\.\d+)?|\.\d+)\s*([a-zA-Zµμ]+)\s*", re.ASCII)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_YEAR_9999 = 253_402_300_800 * 10**9


def trail(frontier: int, lag: int) -> int:
    """The frontier of a port that may emit `lag` ns behind the firing; the ends of time stay."""
    return frontier if frontier in (NEVER, FOREVER) else max(NEVER, frontier - lag)


def parse_duration(value: str | int) -> int:
    """Nanoseconds of a duration such as ``"100ms"``, ``"1.5s"`` or ``"2min"``; an int is nanoseconds. Decimals are
    exact: a duration that is not a whole number of nanoseconds is refused, never rounded."""
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        raise ValueError(
            f"duration {value!r}: expected a number with a unit, such as '100ms', or nanoseconds as an int"
        )
    if isinstance(value, int):
        nanoseconds = value
    else:
        match = _DURATION.fullmatch(value)
        if match is None:
            hint = " (a bare number needs a unit)" if re.fullmatch(r"\s*-?[\d.]+\s*", value) else ""
            raise ValueError(f"duration {value!r}: expected a number and a unit, such as '100ms' or '1.5s'{hint}")
        sign, digits, unit = match.groups()
        if unit not in NANOSECONDS:
            raise ValueError(f"duration {value!r}: unknown unit {unit!r}; the units are {', '.join(NANOSECONDS)}")
        exact = Fraction(digits) * NANOSECONDS[unit]
        if exact.denominator != 1:
            raise ValueError(f"duration {value!r} is not a whole number of nanoseconds")
        nanoseconds = -exact.numerator if sign else exact.numerator
    if not 0 <= nanoseconds < FOREVER:
        raise ValueError(f"duration {value!r}: must be from 0 to {format_duration(FOREVER - 1)}")
    return nanoseconds


def format_duration(duration: int) -> str:
    """The exact text of `duration` (ns) in the largest unit from ns to s that it fills: ``"1.5s"``."""
    sign, magnitude = ("-", -duration) if duration < 0 else ("", duration)
    unit = next((u for u in ("s", "ms", "us") if magnitude >= NANOSECONDS[u]), "s" if magnitude == 0 else "ns")
    whole, rest = divmod(magnitude, NANOSECONDS[unit])
    decimals = f"{rest:0{len(str(NANOSECONDS[unit])) - 1}d}".rstrip("0") if rest else ""
    return f"{sign}{whole}{'.' + decimals if decimals else ''}{unit}"


def format_stamp(stamp: int) -> str:
    """`stamp` for people: ISO 8601 in UTC with nine decimals, or seconds where it is no calendar date."""
    if stamp == NEVER:
        return "never"
    if stamp == FOREVER:
        return "forever"
    seconds, nanoseconds = divmod(stamp, 10**9)
    if stamp < 10**8 * 10**9 or stamp >= _YEAR_9999:  # before 1973: a clock that starts near zero
        sign, magnitude = ("-", -stamp) if stamp < 0 else ("", stamp)
        seconds, nanoseconds = divmod(magnitude, 10**9)
        return f"{sign}{seconds}.{nanoseconds:09d}s"
    return f"{(_EPOCH + timedelta(seconds=seconds)).strftime('%Y-%m-%dT%H:%M:%S')}.{nanoseconds:09d}Z"
