"""NMEA 0183: sentences out of a stream of bytes, and positions out of sentences."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from dataflow.messages import NavSatFix

Clock = Literal["machine", "receiver"]

LONGEST = 250
"""Bytes of a sentence. The standard has 82; receivers exceed it."""
SECOND = 10**9
DAY = 86400 * SECOND
GST_HOLDS = 2 * SECOND
"""Time for which the errors that a GST sentence gives hold."""

_BODY = re.compile(rb"\$[\x20-\x23\x25-\x29\x2b-\x7e]*")
_CHECKSUM = re.compile(rb"\*[0-9A-Fa-f]{2}")
_ADDRESS = re.compile(r"[A-Z0-9]{2}([A-Z]{3})")
_NUMBER = re.compile(r"-?(?:\d{1,9}(?:\.\d{0,12})?|\.\d{1,12})")
_TIME = re.compile(r"(\d\d)(\d\d)(\d\d)(?:\.(\d{0,9}))?")
_PLACE = re.compile(r"(\d{2,3})(\d\d(?:\.\d{0,12})?)")
_QUALITY = re.compile("[0-9]?")
_STATUS = {"1": "fix", "2": "sbas", "3": "fix", "4": "rtk_fixed", "5": "rtk_float", "9": "sbas"}
"""By the quality of GGA. Dead reckoning (6), manual input (7) and simulation (8) are no fixes."""


@dataclass(frozen=True, slots=True)
class Sentence:
    """One sentence whose checksum is right, with the arrival of its first byte in nanoseconds."""

    arrival: int
    kind: str
    """The last three letters of the address; "" for a proprietary one."""
    fields: tuple[str, ...]


class Sentences:
    """Finds the sentences in a stream of bytes that comes in chunks of any size, and skips the bytes between them."""

    def __init__(self) -> None:
        self.bad = 0
        """Sentences cut off, too long, without a checksum or with a wrong one."""
        self._held, self._arrival = b"", 0

    def feed(self, data: bytes, arrival: int) -> Iterator[Sentence]:
        """Yields the sentences that end in `data`, which arrived at `arrival` (ns): those that begin in one chunk lie
        1 ns apart."""
        text, old, begun, start = self._held + data, bool(self._held), 0, 0
        while (start := text.find(b"$", start)) >= 0:
            if start or not old:
                self._arrival = arrival + begun
                begun += 1
            body = _BODY.match(text, start, start + LONGEST)
            assert body is not None
            end = body.end()
            if end - start < LONGEST and len(text) < end + 3 and b"*".startswith(text[end : end + 1]):
                break  # it goes on in the next chunk
            checksum = _CHECKSUM.match(text, end)
            right = checksum is not None and int(text[end + 1 : end + 3], 16) == _sum(text[start + 1 : end])
            self.bad += not right
            if right:
                yield _sentence(text[start + 1 : end].decode("ascii"), self._arrival)
            start = end
        self._held = text[start:] if start >= 0 else b""

    def cut(self) -> None:
        """Drops the sentence that has begun: no more comes."""
        self.bad += bool(self._held)
        self._held = b""


class Receiver:
    """Makes positions of what a receiver sends: one from each GGA sentence, with the date of RMC and the errors of GST.

    Without GST, the errors east and north are the horizontal dilution times `range_error`, and upwards twice that; of
    real-time kinematics they are unknown then.
    """

    def __init__(self, frame: str, clock: Clock, range_error: float) -> None:
        self._frame, self._clock, self._range_error = frame, clock, range_error
        self._sentences = Sentences()
        self._utc: int | None = None
        self._last = 0
        self._errors: tuple[int, tuple[float, float, float]] | None = None
        self.bytes, self.malformed, self.undated = 0, 0, 0
        self.kinds: Counter[str] = Counter()

    @property
    def bad(self) -> int:
        """Sentences that were dropped: damaged, or with fields that mean nothing."""
        return self._sentences.bad + self.malformed

    def feed(self, data: bytes, arrival: int) -> Iterator[NavSatFix]:
        """Yields the positions that end in `data`, which arrived at `arrival` (ns). Raises nothing, whatever it is."""
        self.bytes += len(data)
        for sentence in self._sentences.feed(data, arrival):
            try:
                fix = self._take(sentence)
            except (ValueError, IndexError):
                self.malformed += 1
                continue
            self.kinds[sentence.kind] += 1
            if fix is not None:
                yield fix

    def cut(self) -> None:
        """Drops the sentence that has begun: the device is gone."""
        self._sentences.cut()

    def _take(self, sentence: Sentence) -> NavSatFix | None:
        fields = sentence.fields
        match sentence.kind:
            case "RMC" if fields[1] == "A" and fields[8]:
                self._utc = _midnight(fields[8]) + _time(fields[0])
            case "GST":
                north, east, up = (number(text) for text in fields[5:8])
                self._errors = (_time(fields[0]), (east, north, up)) if min(east, north, up) > 0 else None
            case "GGA":
                return self._position(sentence)
        return None

    def _position(self, sentence: Sentence) -> NavSatFix | None:
        time, lat, north, lon, east, quality, satellites, dilution, height, _, geoid = sentence.fields[:11]
        if not _QUALITY.fullmatch(quality):
            raise ValueError(f"{quality!r} is no quality")
        status = _STATUS.get(quality, "no_fix")
        fixed = status != "no_fix"
        latitude = _place(lat, north, "NS", 90) if fixed else math.nan
        longitude = _place(lon, east, "EW", 180) if fixed else math.nan
        altitude = number(height) + number(geoid) if fixed and height and geoid else math.nan
        errors = self._error(status, _time(time), number(dilution) if dilution else 0.0) if fixed else None
        seen = _count(satellites) if satellites else None
        if time:
            _time(time)
        stamp = self._stamp(sentence.arrival, time)
        if stamp is None:
            return None
        return NavSatFix(
            stamp=stamp,
            frame=self._frame,
            status=status,
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            satellites=seen,
            covariance_type=errors[0] if errors else "unknown",
            covariance=np.diag(np.square(errors[1])) if errors else None,
        )

    def _error(self, status: str, time: int, dilution: float) -> tuple[str, tuple[float, float, float]] | None:
        """Standard deviations east, north, up (m) and how far they are known; None where they are not."""
        if self._errors is not None and (time - self._errors[0]) % DAY <= GST_HOLDS:
            return "diagonal_known", self._errors[1]
        if dilution <= 0 or status.startswith("rtk"):
            return None
        error = dilution * self._range_error
        return "approximated", (error, error, 2 * error)

    def _stamp(self, arrival: int, time: str) -> int | None:
        """The time of a position; None where the date is not known yet, or the last position has the same."""
        if self._clock == "machine":
            return arrival
        if self._utc is None or not time:
            self.undated += 1
            return None
        self._utc += (_time(time) - self._utc + DAY // 2) % DAY - DAY // 2
        if self._utc == self._last:
            return None
        self._last = self._utc
        return self._utc


def _sum(body: bytes) -> int:
    found = 0
    for byte in body:
        found ^= byte
    return found


def _sentence(body: str, arrival: int) -> Sentence:
    address, *fields = body.split(",")
    named = _ADDRESS.fullmatch(address)
    return Sentence(arrival, named[1] if named else "", tuple(fields))


def number(text: str) -> float:
    """Returns the value of plain digits with an optional point and minus. Raises ValueError."""
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{text!r} is no number")
    return float(text)


def _count(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"{text!r} is no count")
    return int(number(text))


def _time(text: str) -> int:
    """Nanoseconds since midnight of hhmmss.sss."""
    found = _TIME.fullmatch(text)
    if not found or int(found[1]) > 23 or int(found[2]) > 59 or int(found[3]) > 60:
        raise ValueError(f"{text!r} is no time")
    seconds = (int(found[1]) * 60 + int(found[2])) * 60 + int(found[3])
    return seconds * SECOND + int((found[4] or "").ljust(9, "0"))


def _midnight(text: str) -> int:
    """Nanoseconds since 1970 of ddmmyy, from 1980 to 2079."""
    if not text.isdecimal() or len(text) != 6:
        raise ValueError(f"{text!r} is no date")
    day, month, year = int(text[:2]), int(text[2:4]), int(text[4:])
    return int(datetime(year + (1900 if year >= 80 else 2000), month, day, tzinfo=UTC).timestamp()) * SECOND


def _place(text: str, half: str, halves: str, most: int) -> float:
    """Degrees of ddmm.mmm and its hemisphere."""
    found = _PLACE.fullmatch(text)
    if not found or half not in halves or len(half) != 1 or float(found[2]) >= 60:
        raise ValueError(f"{text!r} {half!r} is no angle")
    degrees = int(found[1]) + float(found[2]) / 60
    if degrees > most:
        raise ValueError(f"{degrees:g} degrees")
    return degrees if half == halves[0] else -degrees
