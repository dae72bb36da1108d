"""Velodyne LiDARs, over UDP or from a capture of their packets (pcap), by the package velodyne-decoder."""

from __future__ import annotations

import os
import struct
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dataflow.messages import Message, PointCloud
from dataflow.operator import Out, Param, Source, SourceError
from operators.sources.ports import lost_datagrams, read_port, udp_port

PACKET = 1206
"""Bytes of a packet with points."""
_PCAP_HEADER, _RECORD_HEADER = 24, 16
_OTHER_KINDS = (
    (b"\x0a\x0d\x0d\x0a", "a pcapng file", "editcap -F pcap IN.pcapng OUT.pcap"),
    (b"\x1f\x8b", "compressed (gzip)", "gunzip it"),
)
_BLOCK = 100
_MARKS = (b"\xff\xee", b"\xff\xdd")
"""Of upper and of lower blocks; only an HDL-64E has lower ones."""
SILENCE = 500_000_000
"""Nanoseconds without packets after which a turn that has begun is dropped."""


class _Velodyne(Source, abstract=True):
    """Holds what a sensor and a capture of it have in common."""

    cloud: Out[PointCloud] = Out(doc="one turn: x forward, y left, z up, with intensities, rings and times of points")

    frame: str = Param("velodyne", min_length=1, doc="frame of the sensor")
    model: Literal["", "HDL32E", "PuckHiRes", "VLP16", "VLP32A", "VLP32B", "VLP32C", "VLS128"] = Param(
        "", doc="model; empty takes that in the packets, which a Puck Hi-Res and some of the VLP-32 do not tell apart"
    )
    min_range: float = Param(0.1, ge=0, unit="m", doc="nearer points are left out")
    max_range: float = Param(200.0, gt=0, unit="m", doc="farther points are left out")
    clock: Literal["arrival", "sensor"] = Param(
        "arrival", doc="clock of the stamps; `sensor` is its time within the hour, of satellites or free, at this hour"
    )

    _packets, _others, _unknown, _early, _last, _arrived = 0, 0, 0, 0, -1, 0
    _refused = ""

    @abstractmethod
    def _received(self) -> Iterator[tuple[int, bytes]]:
        """Yields the arrival (ns) of datagrams, and their bytes; none with no bytes."""

    def setup(self) -> None:
        """Raises SourceError where the package is not installed."""
        try:
            import velodyne_decoder
        except ModuleNotFoundError as error:
            raise SourceError(
                f"Velodyne LiDARs need the package {error.name}: pip install 'robot-dataflow[lidar]'"
            ) from error
        self._library: Any = velodyne_decoder
        self._begin()

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for arrival, data in self._received():
            if not _has_points(data):  # position packets, other programs
                self._others += bool(data)
                continue
            if arrival - self._arrived > SILENCE:
                self._begin()
            self._packets, self._arrived = self._packets + 1, arrival
            yield from self._clouds(self._turn(self._decoder.decode, arrival * 1e-9, data))
        yield from self._clouds(self._turn(self._decoder.finish))

    def summary(self) -> Mapping[str, int | str]:
        found = {"clock": self.clock, "packets": self._packets, "other_datagrams": self._others}
        return {**found, "undecoded": self._unknown, "past": self._early}

    def finding(self) -> str:
        if self._refused and self._last < 0:
            return f"{self._packets} packets, none that can be decoded: {self._refused}"
        if self._others and not self._packets:
            return f"{self._others} datagrams, none of {PACKET} bytes: is it a Velodyne LiDAR, is that its data port?"
        return ""

    def _begin(self) -> None:
        """Begins a turn anew; the first one after it is whole only where it begins at its first packet."""
        library = self._library
        model = getattr(library.Model, self.model) if self.model else None
        settings = library.Config(model=model, min_range=self.min_range, max_range=self.max_range)
        self._decoder = library.StreamDecoder(settings)

    def _turn(self, decode: Callable[..., Any], *given: Any) -> Any:
        """Returns what the decoder gives; nothing for packets of a model that it does not know, or of another one."""
        try:
            return decode(*given)
        except RuntimeError as error:
            self._refused, self._unknown = str(error), self._unknown + 1
            self._begin()  # the decoder would come upon the same packet again; this turn is lost
        return None

    def _clouds(self, turn: Any) -> Iterator[Mapping[str, Message]]:
        if turn is None or not len(turn[1]):
            return
        times, rows = turn
        stamp = round((times.host if self.clock == "arrival" else times.device) * 1e9)
        if stamp <= self._last and not self.real_time:
            self._early += 1
            return
        self._last = stamp
        yield {
            "cloud": PointCloud(
                stamp=stamp,
                frame=self.frame,
                points=rows[:, :3],
                intensities=rows[:, 3],
                rings=rows[:, 6].astype(np.uint16),
                time_offsets=rows[:, 4],
            )
        }


class VelodyneFile(_Velodyne):
    """Reads the clouds in a capture of a Velodyne's packets (pcap, as tcpdump writes it), one for each turn.

    A cloud is stamped when its last packet was captured, or with `clock: sensor` by the sensor's own time; points have
    times relative to that. Needs the extra `[lidar]`.
    """

    input: str = Param(min_length=1, doc="the file")

    _broken_off = ""

    def setup(self) -> None:
        """Raises SourceError, FileNotFoundError."""
        self._path = self.use_file(Path(self.input).expanduser())
        super().setup()

    def finding(self) -> str:
        """Returns what is wrong with the file, where nothing came out of it, or not all."""
        if not (self._packets or self._others):
            return f"{self._path.name} holds no packet"
        return super().finding() or self._broken_off

    def _received(self) -> Iterator[tuple[int, bytes]]:
        util = self._library.util
        self._check_kind()
        try:
            for stamp, data in util.iter_pcap(self._path):
                yield round(float(stamp) * 1e9), bytes(data)
        except (ValueError, util.dpkt.Error) as error:
            if not self._packets:
                raise SourceError(f"{self._path} is no capture of packets (pcap): {error}") from error
            self._broken_off = str(error)
        if self._broken_off or _is_cut(self._path):
            self._broken_off = f"{self._path.name} breaks off in a packet: {self._packets} before it were read"
            self.log.warning("%s", self._broken_off)

    def _check_kind(self) -> None:
        """Raises SourceError for a file that would only have to be converted."""
        with self._path.open("rb") as file:
            magic = file.read(4)
        for begins, kind, how in _OTHER_KINDS:
            if magic.startswith(begins):
                raise SourceError(f"{self._path} is {kind}, not a pcap: {how}")


def _has_points(data: bytes) -> bool:
    """Returns whether it is a packet with points: twelve blocks, each of which begins with its mark."""
    return len(data) == PACKET and all(data[at : at + 2] in _MARKS for at in range(0, 12 * _BLOCK, _BLOCK))


def _is_cut(path: Path) -> bool:
    """Returns whether a pcap ends within a packet."""
    size = path.stat().st_size
    with path.open("rb") as file:
        order = "<" if file.read(_PCAP_HEADER)[:1] in b"\xd4\x4d" else ">"
        at = _PCAP_HEADER
        while head := file.read(_RECORD_HEADER):
            if len(head) < _RECORD_HEADER:
                return True
            at += _RECORD_HEADER + int(struct.unpack(f"{order}8xI4x", head)[0])
            if at > size:
                return True
            file.seek(at)
    return False


class VelodyneLidar(_Velodyne):
    """Reads a Velodyne LiDAR of the network, one cloud for each turn.

    A cloud is stamped when its last packet arrived, or with `clock: sensor` by the sensor's own time, which is right
    where it is synchronised to satellites or PTP; points have times relative to that. A sensor that is silent is waited
    for, and its turn that had begun is dropped. Needs the extra `[lidar]`.
    """

    real_time = True

    input: str = Param("udp://0.0.0.0:2368", min_length=1, doc="udp://ADDRESS:PORT of this machine")

    _silences, _port, _lost = 0, -1, 0

    def setup(self) -> None:
        """Raises SourceError where the package or the address is not there."""
        super().setup()
        self._stopped = threading.Event()
        try:
            self._port = udp_port(self.input)
        except OSError as error:
            raise SourceError(f"no socket at {self.input!r}: {error.strerror or error}") from error

    def stop_reading(self) -> None:
        self._stopped.set()

    def close(self) -> None:
        if self._port >= 0:
            self._lost = lost_datagrams(self._port)
            os.close(self._port)
            self._port = -1

    def summary(self) -> Mapping[str, int | str]:
        lost = self._lost if self._port < 0 else lost_datagrams(self._port)
        return {**super().summary(), "unplugged": self._silences, "lost_datagrams": lost}

    def _received(self) -> Iterator[tuple[int, bytes]]:
        silent = False
        while not self._stopped.is_set():
            data, arrival = read_port(self._port)
            if data is None and not silent and self._packets and arrival - self._arrived > SILENCE:
                self._silences += 1
                silent = True
                self.log.warning("no packets from the LiDAR at %s: it is waited for", self.input)
            silent = silent and data is None
            yield arrival, data or b""
