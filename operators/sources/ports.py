"""Devices that send bytes, at a serial port or over UDP; they may be unplugged."""

from __future__ import annotations

import os
import select
import socket
import stat
import termios
import threading
import time
import tty
from abc import abstractmethod
from collections.abc import Iterator, Mapping

import numpy as np

from dataflow.messages import Message
from dataflow.operator import Param, Source, SourceError

SHORTEST_PAUSE, LONGEST_PAUSE = 0.1, 5.0
"""Seconds between two looks for a device that is gone: doubled from one to the next."""
POLL = 200
"""Milliseconds after which a wait for bytes looks whether the run has ended."""
BUFFER = 4 << 20
"""Bytes of datagrams that may wait; the machine's net.core.rmem_max bounds them further."""
_MEMINFO, _DROPS = 55, 8
"""Linux's SO_MEMINFO, and the place of the dropped datagrams in it (sock_diag(7))."""


class PortSource(Source, abstract=True):
    """Reads the bytes of a device; one that is unplugged is looked for after 0.1 s, then after pauses doubled up to
    5 s."""

    real_time = True

    input: str = Param("/dev/ttyACM0", min_length=1, doc="serial device, or udp://ADDRESS:PORT of this machine")
    baud: int = Param(9600, ge=1, unit="Bd", doc="rate of the serial port; USB devices take any")

    _device = "device"
    _unplugged = 0
    _port = -1

    @abstractmethod
    def _take(self, data: bytes, arrival: int) -> Iterator[Mapping[str, Message]]:
        """Yields what ends in bytes that arrived at a time (ns)."""

    @abstractmethod
    def _cut(self) -> None:
        """Drops what has begun: the device is gone."""

    def setup(self) -> None:
        """Raises SourceError where there is no such device or address."""
        self._stopped = threading.Event()
        self._datagrams = self.input.startswith("udp://")
        try:
            self._port = self._open()
        except OSError as error:
            raise SourceError(
                f"no {self._device} at {self.input!r}: {error.strerror or error}; `dataflow devices` lists what is "
                "there"
            ) from error

    def stream(self) -> Iterator[Mapping[str, Message]]:
        while not self._stopped.is_set():
            try:
                data, arrival = self._read()
            except OSError as error:
                self._look_for_it(error)
                continue
            yield from self._take(data, arrival)

    def stop_reading(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        if self._port >= 0:
            os.close(self._port)
            self._port = -1

    def _open(self) -> int:
        return udp_port(self.input) if self._datagrams else _serial_port(self.input, self.baud)

    def _read(self) -> tuple[bytes, int]:
        """The next bytes, none after a pause, and their arrival (ns). Raises OSError for a device that is gone."""
        data, arrival = read_port(self._port)
        if data == b"" and not self._datagrams:
            raise OSError("it was unplugged")
        return data or b"", arrival

    def _look_for_it(self, error: OSError) -> None:
        """Waits until the device is back, or the run ends."""
        self.close()
        self._cut()
        self._unplugged += 1
        self.log.warning("%s %s is gone (%s): it is looked for", self._device, self.input, error.strerror or error)
        pause = SHORTEST_PAUSE
        while not self._stopped.wait(pause):
            try:
                self._port = self._open()
            except (OSError, SourceError):  # a device file that appears has its group a moment later
                pause = min(2 * pause, LONGEST_PAUSE)
            else:
                self.log.info("%s %s is back", self._device, self.input)
                return


def read_port(port: int) -> tuple[bytes | None, int]:
    """Returns what a file descriptor gives within `POLL`, None for nothing, and its arrival (ns). Raises OSError."""
    poll = select.poll()
    poll.register(port, select.POLLIN)
    ready = poll.poll(POLL)
    arrival = time.time_ns()
    if not ready:
        return None, arrival
    try:
        return os.read(port, 65536), arrival
    except BlockingIOError:  # a datagram whose checksum was wrong
        return None, arrival


def udp_port(address: str) -> int:
    """Returns the file descriptor of a socket that receives at udp://ADDRESS:PORT. Raises SourceError, OSError."""
    host, _, port = address.removeprefix("udp://").rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise SourceError(f"{address!r} is no address: udp://ADDRESS:PORT, such as udp://127.0.0.1:10110")
    host = host.strip("[]")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM) as found:
        found.setblocking(False)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        found.bind((host, int(port)))
        return found.detach()


def lost_datagrams(port: int) -> int:
    """Returns how many datagrams found no room in a socket's buffer, or were damaged, since it was opened."""
    with socket.socket(fileno=os.dup(port)) as found:
        memory = np.frombuffer(found.getsockopt(socket.SOL_SOCKET, _MEMINFO, 4 * (_DROPS + 1)), np.uint32)
    return int(memory[_DROPS])


def _serial_port(path: str, baud: int) -> int:
    """File descriptor of a serial device: raw, 8N1, without flow control. Raises SourceError, OSError."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        rates = sorted(int(name[1:]) for name in vars(termios) if name[0] == "B" and name[1:].isdecimal())
        raise SourceError(f"a serial port has no rate of {baud} baud: {', '.join(map(str, rates[1:]))}")
    if stat.S_ISREG(os.stat(path).st_mode):
        raise SourceError(f"{path} is a file, no serial device: operators.sources:NmeaFile reads logs of NMEA 0183")
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
