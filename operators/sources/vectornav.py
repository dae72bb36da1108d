"""IMUs that send VectorNav's ASCII messages, at a serial port or over UDP.

VectorNav, "VN-100 user manual", UM001, has the messages:

    $VNIMU,magX,magY,magZ,accX,accY,accZ,gyroX,gyroY,gyroZ,temperature,pressure*hh
    $VNYMR,yaw,pitch,roll,magX,magY,magZ,accX,accY,accZ,gyroX,gyroY,gyroZ*hh

in gauss, m/s², rad/s, °C, with an exclusive or of the bytes as the checksum, as NMEA 0183 has.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Imu, MagneticField, Message
from dataflow.operator import Duration, Out, Param
from operators.sources.nmea import Sentence, Sentences, number
from operators.sources.ports import PortSource

Vector = NDArray[np.float64]

GAUSS = 1e-4
"""Tesla."""
SOME = 20
"""Messages after which an IMU without samples is found wrong."""


class Sample(NamedTuple):
    """One message: vectors (3,) in rad/s, m/s² and tesla, in the sensor's axes; the temperature in °C."""

    angular_velocity: Vector
    specific_force: Vector
    field: Vector
    temperature: float | None


class VectorNavImu(PortSource):
    """Reads an IMU that sends VectorNav's $VNIMU or $VNYMR, at a serial port (8N1) or over UDP.

    Stamps are the machine's clock when the first byte of the message arrived, less `latency`: these messages hold no
    time. Messages that arrive together keep their order, 1 ns apart. Vectors are in the sensor's own axes, x forward,
    y right, z down, as the mount of its frame has to say.

    An IMU that is unplugged is looked for after 0.1 s, then after pauses doubled up to 5 s, and counted; messages that
    are cut off, or whose checksum or numbers are wrong, are dropped and counted.
    """

    imu: Out[Imu] = Out(doc="angular velocity and specific force, one for each message")
    field: Out[MagneticField] = Out(doc="magnetic field, of the same moment")

    input: str = Param("/dev/ttyUSB0", min_length=1, doc="serial device, or udp://ADDRESS:PORT of this machine")
    baud: int = Param(115200, ge=1, unit="Bd", doc="rate of the serial port")
    frame: str = Param("imu", min_length=1, doc="frame of the sensor")
    latency: Duration = Param("0s", ge=0, doc="time from the measurement to the arrival of its first byte")

    _device = "IMU"
    _malformed = 0

    def setup(self) -> None:
        """Raises SourceError where there is no such device or address."""
        self._sentences, self._kinds = Sentences(), Counter[str]()
        super().setup()

    def summary(self) -> Mapping[str, int | str]:
        kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(self._kinds.items()))
        return {
            "clock": "machine",
            "messages": kinds or "none",
            "bad_messages": self._sentences.bad + self._malformed,
            "unplugged": self._unplugged,
        }

    def finding(self) -> str:
        good, bad = self._kinds.total(), self._sentences.bad + self._malformed
        if good + bad < SOME:
            return ""
        if bad > good:
            return f"{bad} of {good + bad} messages are damaged: is the baud rate right?"
        if not self._kinds["IMU"] + self._kinds["YMR"]:
            return f"no samples: the IMU sends {', '.join(sorted(self._kinds))}, and neither VNIMU nor VNYMR"
        return ""

    def _take(self, data: bytes, arrival: int) -> Iterator[Mapping[str, Message]]:
        for sentence in self._sentences.feed(data, arrival - self.latency):
            try:
                sample = sample_of(sentence)
            except ValueError:
                self._malformed += 1
                continue
            self._kinds[sentence.kind or "other"] += 1
            if sample is None:
                continue
            stamp = sentence.arrival
            gyro, force, field, temperature = sample
            yield {
                "imu": Imu(
                    stamp=stamp,
                    frame=self.frame,
                    temperature=temperature,
                    angular_velocity=gyro,
                    linear_acceleration=force,
                ),
                "field": MagneticField(stamp=stamp, frame=self.frame, field=field),
            }

    def _cut(self) -> None:
        self._sentences.cut()


def sample_of(sentence: Sentence) -> Sample | None:
    """Returns what a message measured; None for one of another kind. Raises ValueError."""
    first = {"IMU": 0, "YMR": 3}.get(sentence.kind)
    if first is None:
        return None
    fields = [number(text.removeprefix("+")) for text in sentence.fields[: 11 if first == 0 else 12]]
    if len(fields) < (11 if first == 0 else 12):
        raise ValueError(f"{len(fields)} numbers in {sentence.kind}")
    field, force, gyro = (np.array(fields[k : k + 3]) for k in (first, first + 3, first + 6))
    return Sample(gyro, force, field * GAUSS, fields[9] if first == 0 else None)
