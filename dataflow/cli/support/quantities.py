"""Times, durations and sizes as people write them on the command line."""

from __future__ import annotations

from dataflow.cli.support.output import fail


def parsed_moment(option: str, word: str, first: int) -> int:
    """A point in time: seconds or a duration after the first message, or a date."""
    from datetime import datetime

    if "T" in word or word.count("-") >= 2:
        try:
            date = datetime.fromisoformat(word)
        except ValueError as error:
            raise fail(f"{option} {word}: {error}") from None
        if date.tzinfo is None:
            raise fail(f"{option} {word}: which time zone? Append Z for UTC, or an offset such as +01:00")
        whole, _, fraction = f"{date.timestamp():.6f}".partition(".")
        return int(whole) * 1_000_000_000 + int(fraction) * 1_000
    return first + parsed_duration(option, word)


def parsed_duration(option: str, word: str) -> int:
    """Nanoseconds of a number of seconds, or of a duration with its unit."""
    from dataflow.sync.stamps import parse_duration

    try:
        found = round(float(word) * 1e9)
    except ValueError:
        try:
            found = parse_duration(word)
        except ValueError as error:
            raise fail(f"{option} {word}: {error}") from None
    if not 0 <= found < 2**62:
        raise fail(f"{option} {word}: expected a time from 0 on")
    if option in ("--every", "--duration") and not found:
        raise fail(f"{option} {word}: expected more than nothing")
    return found


def speed_text(speed: float | None) -> str:
    """A pace against the clock, in words."""
    return "as fast as it goes" if speed is None else f"{speed:g} x real time"


UNITS = {"": 1, "B": 1, "kB": 10**3, "KB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12} | {
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
    "TiB": 2**40,
}


def parsed_size(option: str, word: str) -> int:
    """Bytes of a size with its unit."""
    number = word.rstrip("BkKMGTi")
    unit = word[len(number) :]
    try:
        found = round(float(number) * UNITS[unit])
    except (KeyError, ValueError):
        raise fail(f"{option} {word}: expected a size such as 500MB, 2GB or 100MiB") from None
    if found < 1:
        raise fail(f"{option} {word}: expected 1 byte or more")
    return found
