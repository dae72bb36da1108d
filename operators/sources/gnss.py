"""Satellite receivers that speak NMEA 0183: at a serial port, over UDP, or in a log file."""

from __future__ import annotations

import os
import select
import socket
import stat
import termios
import threading
import time
import tty
from collections.abc import Iterator, Mapping
from pathlib import Path

from dataflow.messages import Message, NavSatFix
from dataflow.operator import Out, Param, Source, SourceError
from operators.sources.nmea import Clock, Receiver

SHORTEST_PAUSE, LONGEST_PAUSE = 0.1, 5.0
"""Seconds between two looks for a receiver that is gone: doubled from one to the next."""
POLL = 200
"""Milliseconds after which a wait for bytes looks whether the run has ended."""
LOUD = 1000
"""Bytes after which a receiver without a position is found wrong."""


class _Nmea(Source):
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


class NmeaGnss(_Nmea):
    """Reads a satellite receiver that sends NMEA 0183, at a serial port (8N1) or over UDP.

    Stamps are the machine's clock when the first byte of the GGA sentence arrived, later than the position by what the
    receiver takes to compute and send it (0.05 to 0.3 s are common), or with `clock: receiver` its UTC, which is the
    position's own time and fits other sensors only where the machine's clock is synchronised. The summary names it.

    A receiver that is unplugged is looked for after 0.1 s, then after pauses doubled up to 5 s, and counted.
    """

    real_time = True

    input: str = Param("/dev/ttyACM0", min_length=1, doc="serial device, or udp://ADDRESS:PORT of this machine")
    baud: int = Param(9600, ge=1, unit="Bd", doc="rate of the serial port; USB receivers take any")
    clock: Clock = Param("machine", doc="clock of the stamps")

    _unplugged = 0
    _port = -1

    def setup(self) -> None:
        """Raises SourceError where there is no such device or address."""
        self._stopped, self._dates = threading.Event(), self.clock
        self._receiver = Receiver(self.frame, self.clock, self.range_error)
        self._datagrams = self.input.startswith("udp://")
        try:
            self._port = self._open()
        except OSError as error:
            raise SourceError(
                f"no receiver at {self.input!r}: {error.strerror or error}; `dataflow devices` lists what is there"
            ) from error

    def stream(self) -> Iterator[Mapping[str, Message]]:
        assert self._receiver is not None
        while not self._stopped.is_set():
            try:
                data, arrival = self._read()
            except OSError as error:
                self._look_for_it(error)
                continue
            for fix in self._receiver.feed(data, arrival):
                yield {"fix": fix}

    def stop_reading(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        if self._port >= 0:
            os.close(self._port)
            self._port = -1

    def summary(self) -> Mapping[str, int | str]:
        return {**super().summary(), "unplugged": self._unplugged}

    def _open(self) -> int:
        return _udp_port(self.input) if self._datagrams else _serial_port(self.input, self.baud)

    def _read(self) -> tuple[bytes, int]:
        """The next bytes, none after a pause, and their arrival (ns). Raises OSError for a device that is gone."""
        poll = select.poll()
        poll.register(self._port, select.POLLIN)
        ready = poll.poll(POLL)
        arrival = time.time_ns()
        if not ready:
            return b"", arrival
        try:
            data = os.read(self._port, 65536)
        except BlockingIOError:  # a datagram whose checksum was wrong
            return b"", arrival
        if not data and not self._datagrams:
            raise OSError("it was unplugged")
        return data, arrival

    def _look_for_it(self, error: OSError) -> None:
        """Waits until the receiver is back, or the run ends."""
        assert self._receiver is not None
        self.close()
        self._receiver.cut()
        self._unplugged += 1
        self.log.warning("receiver %s is gone (%s): it is looked for", self.input, error.strerror or error)
        pause = SHORTEST_PAUSE
        while not self._stopped.wait(pause):
            try:
                self._port = self._open()
            except (OSError, SourceError):  # a device file that appears has its group a moment later
                pause = min(2 * pause, LONGEST_PAUSE)
            else:
                self.log.info("receiver %s is back", self.input)
                return


def _udp_port(address: str) -> int:
    """File descriptor of a socket. Raises SourceError, OSError."""
    host, _, port = address.removeprefix("udp://").rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise SourceError(f"{address!r} is no address: udp://ADDRESS:PORT, such as udp://127.0.0.1:10110")
    host = host.strip("[]")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.setblocking(False)
        found.bind((host, int(port)))
        return found.detach()


def _serial_port(path: str, baud: int) -> int:
    """File descriptor of a serial device: raw, 8N1, without flow control. Raises SourceError, OSError."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        rates = sorted(int(name[1:]) for name in vars(termios) if name[0] == "B" and name[1:].isdecimal())
        raise SourceError(f"a serial port has no rate of {baud} baud: {', '.join(map(str, rates[1:]))}")
    if stat.S_ISREG(os.stat(path).st_mode):
        raise SourceError(f"{path} is a file: operators.sources:NmeaFile reads it")
    port = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(port, termios.TCSANOW)
        settings = termios.tcgetattr(port)
        settings[2] = settings[2] & ~(termios.CSTOPB | termios.CRTSCTS) | termios.CLOCAL | termios.CREAD
        settings[4] = settings[5] = speed
        termios.tcsetattr(port, termios.TCSANOW, settings)
        termios.tcflush(port, termios.TCIFLUSH)  # what has waited would be stamped with now
    except termios.error as error:
        os.close(port)
        raise OSError(f"no serial device ({error.args[-1]})") from error
    return port
