"""Satellite receivers that speak NMEA 0183: at a serial port, over UDP, or in a log file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from dataflow.messages import Message, NavSatFix
from dataflow.operator import Out, Param, Source
from operators.sources.nmea import Clock, Receiver
from operators.sources.ports import PortSource

LOUD = 1000
"""Bytes after which a receiver without a position is found wrong."""


class _Nmea(Source, abstract=True):
    """Holds what a receiver and its log have in common."""

    fix: Out[NavSatFix] = Out(doc="position, one for each GGA sentence; without a fix its coordinates are NaN")

    frame: str = Param("gnss", min_length=1, doc="frame of the antenna")
    range_error: float = Param(
        4.0, gt=0, unit="m", doc="error of the ranges to satellites, for receivers without GST sentences"
    )

    _receiver: Receiver | None = None
    _dates = "receiver"

    def summary(self) -> Mapping[str, int | str]:
        found = self._receiver
        if found is None:
            return {}
        kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(found.kinds.items()) if kind)
        return {"clock": self._dates, "sentences": kinds or "none", "bad_sentences": found.bad}

    def finding(self) -> str:
        found = self._receiver
        if found is None or found.bytes < LOUD:
            return ""
        if found.bad > found.kinds.total():
            return f"{found.bad} of {found.bad + found.kinds.total()} sentences are damaged: is the baud rate right?"
        if not found.kinds:
            return f"{found.bytes} bytes without an NMEA sentence: is the baud rate right, is it a binary protocol?"
        if not found.kinds["GGA"]:
            return f"no position: the receiver sends {', '.join(sorted(filter(None, found.kinds)))} and no GGA"
        if found.undated == found.kinds["GGA"]:
            return "no stamp: no RMC sentence with a fix has given the date"
        return ""


class NmeaFile(_Nmea):
    """Reads a log of NMEA 0183 sentences. Positions are stamped with the receiver's UTC, its date from RMC sentences;
    those before the first date are left out.

    Damaged sentences are counted, and positions of the past, which follow a correction of its clock, are left out and
    counted. Dates are the receiver's, also where it is off by a rollover of its weeks.
    """

    input: str = Param(min_length=1, doc="the file")

    _past = 0

    def setup(self) -> None:
        """Raises FileNotFoundError."""
        self._path = self.use_file(Path(self.input).expanduser())
        self._receiver = Receiver(self.frame, "receiver", self.range_error)

    def stream(self) -> Iterator[Mapping[str, Message]]:
        assert self._receiver is not None
        last = -1
        with self._path.open("rb") as log:
            while data := log.read(65536):
                for fix in self._receiver.feed(data, 0):
                    if fix.stamp <= last:
                        self._past += 1
                        continue
                    last = fix.stamp
                    yield {"fix": fix}
        self._receiver.cut()

    def summary(self) -> Mapping[str, int | str]:
        return {**super().summary(), "past": self._past}


class NmeaGnss(_Nmea, PortSource):
    """Reads a satellite receiver that sends NMEA 0183, at a serial port (8N1) or over UDP.

    Stamps are the machine's clock when the first byte of the GGA sentence arrived, later than the position by what the
    receiver takes to compute and send it (0.05 to 0.3 s are common), or with `clock: receiver` its UTC, which is the
    position's own time and fits other sensors only where the machine's clock is synchronised. The summary names it.

    A receiver that is unplugged is looked for after 0.1 s, then after pauses doubled up to 5 s, and counted.
    """

    clock: Clock = Param("machine", doc="clock of the stamps")

    _device = "receiver"

    def setup(self) -> None:
        """Raises SourceError where there is no such device or address."""
        self._dates = self.clock
        self._receiver = Receiver(self.frame, self.clock, self.range_error)
        PortSource.setup(self)

    def summary(self) -> Mapping[str, int | str]:
        return {**super().summary(), "unplugged": self._unplugged}

    def _take(self, data: bytes, arrival: int) -> Iterator[Mapping[str, Message]]:
        assert self._receiver is not None
        for fix in self._receiver.feed(data, arrival):
            yield {"fix": fix}

    def _cut(self) -> None:
        assert self._receiver is not None
        self._receiver.cut()
