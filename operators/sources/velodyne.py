"""Velodyne LiDARs, over UDP or from a capture of their packets (pcap), by the package velodyne-decoder."""

from __future__ import annotations

import os
import threading
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dataflow.messages import Message, PointCloud
from dataflow.operator import Out, Param, Source, SourceError
from operators.sources.capture import CaptureError, records
from operators.sources.ports import lost_datagrams, read_port, udp_port

PACKET = 1206
"""Bytes of a packet with points."""
BANKS = (0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF)
"""By which the blocks of a packet begin: the lasers whose returns follow."""
SILENCE = 500_000_000
"""Nanoseconds without packets after which a turn that has begun is dropped."""


class _Velodyne(Source, abstract=True):
    """Holds what a sensor and a capture of it have in common."""

    cloud: Out[PointCloud] = Out(doc="one turn: x forward, y left, z up, with intensities, rings and times of points")

    frame: str = Param("velodyne", min_length=1, doc="frame of the sensor")
    model: Literal["", "HDL32E", "PuckHiRes", "VLP16", "VLP32A", "VLP32B", "VLP32C", "VLS128"] = Param(
        "", doc="model; empty takes that in the packets, which are the same for a Puck Hi-Res and some of the VLP-32"
    )
    min_range: float = Param(0.1, ge=0, unit="m", doc="nearer points are left out")
    max_range: float = Param(200.0, gt=0, unit="m", doc="farther points are left out")
    clock: Literal["arrival", "sensor"] = Param(
        "arrival", doc="clock of the stamps; `sensor` is its time within the hour, of satellites or free, at this hour"
    )

    _packets, _others, _early, _last, _arrived = 0, 0, 0, -1, 0

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
        self._models: dict[int, bool] = {}
        self._begin()

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for arrival, data in self._received():
            if not self._takes(data):  # position packets, other programs
                self._others += bool(data)
                continue
            if arrival - self._arrived > SILENCE:
                self._begin()
            if not self._is_of_the_turn(data[-1]):
                self._others += 1
                continue
            self._packets, self._arrived = self._packets + 1, arrival
            yield from self._clouds(self._decoder.decode(arrival * 1e-9, data))
        yield from self._clouds(self._decoder.finish())

    def summary(self) -> Mapping[str, int | str]:
        found = {"clock": self.clock, "packets": self._packets, "other_datagrams": self._others}
        return {**found, "past": self._early}

    def finding(self) -> str:
        if self._others and not self._packets:
            return (
                f"{self._others} datagrams, none of them a packet with points ({PACKET} bytes): is it a Velodyne "
                "LiDAR, is that its data port?"
            )
        return ""

    def _takes(self, data: bytes) -> bool:
        """Returns whether a datagram is a packet with points of a known model; any program may send others."""
        if not _has_points(data):
            return False
        known = self._models.get(data[-1])
        if known is None:
            try:
                trial = self._new_decoder()  # the run's own one would be left with its turn in pieces
                trial.decode(0.0, data)
                trial.finish()
                known = True
            except RuntimeError as error:
                self.log.warning("packets are left out: %s", error)
                known = False
            self._models[data[-1]] = known
        return known

    def _begin(self) -> None:
        """Begins a turn anew; the first one after it is whole only where it begins at its first packet."""
        self._decoder, self._one, self._strangers = self._new_decoder(), -1, set[int]()

    def _is_of_the_turn(self, model: int) -> bool:
        """Returns whether a packet's model is that of the packets before: a decoder takes one model."""
        if self._one < 0:
            self._one = model
        if model != self._one and model not in self._strangers:
            self._strangers.add(model)
            self.log.warning("packets of model %d are left out: those before are of model %d", model, self._one)
        return model == self._one

    def _new_decoder(self) -> Any:
        library = self._library
        model = getattr(library.Model, self.model) if self.model else None
        return library.StreamDecoder(library.Config(model=model, min_range=self.min_range, max_range=self.max_range))

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

    _broken = ""

    def setup(self) -> None:
        """Raises SourceError, FileNotFoundError."""
        self._path = self.use_file(Path(self.input).expanduser())
        super().setup()

    def finding(self) -> str:
        """Returns what is wrong with the file, where nothing came out of it or it breaks off."""
        if not (self._packets or self._others):
            return f"{self._path.name} holds no packet"
        return self._broken or super().finding()

    def _received(self) -> Iterator[tuple[int, bytes]]:
        layers = self._library.util.dpkt
        try:
            for stamp, frame in records(self._path):
                try:
                    data = layers.ethernet.Ethernet(frame)
                except layers.UnpackError:
                    continue
                while hasattr(data, "data"):
                    data = data.data
                yield stamp, bytes(data)
        except CaptureError as error:
            if not self._packets:
                raise SourceError(str(error)) from error
            self._broken = f"{error}, after {self._packets} packets"
            self.log.warning("%s", self._broken)


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


def _has_points(data: bytes) -> bool:
    """Returns whether a datagram has the twelve blocks of a packet with points; of anything else a decoder would make
    turns."""
    if len(data) != PACKET:
        return False
    begins = np.frombuffer(data, "<u2", 600).reshape(12, 50)
    return bool(np.isin(begins[:, 0], BANKS).all() and (begins[:, 1] <= 36000).all())
