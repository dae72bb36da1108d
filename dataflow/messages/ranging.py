"""Planar lidar and radar scans."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from dataflow.messages.arrays import F32, I64
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import finite


class LaserScan(Message):
    """One sweep of a planar lidar, about the z axis of its frame, counter-clockwise from x.

    Beam i points along `angle_min + i * (angle_max - angle_min) / (N - 1)`; a scanner that turns clockwise has
    `angle_max < angle_min`.
    """

    frame: str = scalar("str", "frame of the scanner", default=ANCHOR)
    angle_min: float = scalar("float", "direction of the first beam, radians")
    angle_max: float = scalar("float", "direction of the last beam, radians")
    range_min: float = scalar("float", "nearest range that counts, metres", default=0.0)
    range_max: float = scalar("float", "farthest range that counts, metres; may be infinite", default=float("inf"))
    ranges: F32 = array("float32", "N", "range per beam; infinite or 0 for no return, NaN for a bad one", unit="m")
    intensities: F32 | None = array("float32", "N", "strength of each return, in the sensor's own scale", default=None)
    time_offsets: F32 | None = array(
        "float32", "N", "when each beam was measured, relative to the stamp", unit="s", default=None
    )

    def validate(self) -> None:
        finite(self, "angle_min", "angle_max", "range_min")
        if not self.range_min <= self.range_max:
            raise MessageError(f"LaserScan.range_min must be ≤ range_max, got {self.range_min} and {self.range_max}")

    @property
    def angle_increment(self) -> float:
        """Angle from one beam to the next, radians; 0 with fewer than two beams."""
        beams = len(self.ranges)
        return (self.angle_max - self.angle_min) / (beams - 1) if beams > 1 else 0.0

    def angles(self) -> npt.NDArray[np.float64]:
        """Direction (N,) of every beam, radians."""
        return np.linspace(self.angle_min, self.angle_max, len(self.ranges))

    def points(self) -> npt.NDArray[np.float64]:
        """Points (M, 3) of the beams whose range is finite, above 0 and in [range_min, range_max], in `frame`."""
        ranges = self.ranges.astype(np.float64)
        good = np.isfinite(ranges) & (ranges > 0) & (ranges >= self.range_min) & (ranges <= self.range_max)
        r, a = ranges[good], self.angles()[good]
        return np.column_stack([r * np.cos(a), r * np.sin(a), np.zeros_like(r)])


class RangeReading(Message):
    """One distance along the x axis of an ultrasonic or infrared sensor, of what is nearest in its cone."""

    frame: str = scalar("str", "frame of the sensor (x along its axis)", default=ANCHOR)
    range: float = scalar("float", "distance, metres; -inf: nearer than it can measure, inf: nothing in reach")
    range_min: float = scalar("float", "nearest range that counts, metres", default=0.0)
    range_max: float = scalar("float", "farthest range that counts, metres; may be infinite", default=float("inf"))
    field_of_view: float = scalar("float", "opening angle of the cone, radians; 0 where not known", default=0.0)
    radiation: str = scalar("str", "what it sends out", default="ultrasound", choices=("ultrasound", "infrared"))
    variance: float | None = scalar("float", "of the range, square metres; None where not known", default=None)


class RadarScan(Message):
    """Detections of one radar cycle, in polar coordinates about the sensor."""

    frame: str = scalar("str", "frame of the radar (x forward, y left, z up)", default=ANCHOR)
    ranges: F32 = array("float32", "N", "distance", unit="m")
    azimuths: F32 = array("float32", "N", "angle from x towards y", unit="rad")
    elevations: F32 | None = array(
        "float32", "N", "angle above the x-y plane; None for a planar radar", unit="rad", default=None
    )
    velocities: F32 | None = array(
        "float32", "N", "radial (Doppler) velocity, positive when moving away", unit="m/s", default=None
    )
    cross_sections: F32 | None = array("float32", "N", "radar cross-section", unit="dBsm", default=None)
    snr: F32 | None = array("float32", "N", "signal-to-noise ratio", unit="dB", default=None)
    ids: I64 | None = array("int64", "N", "the sensor's own identity of each detection", default=None)

    @property
    def count(self) -> int:
        """Number of detections."""
        return len(self.ranges)

    def points(self) -> npt.NDArray[np.float64]:
        """Cartesian points (N, 3) in `frame`, metres."""
        r, a = self.ranges.astype(np.float64), self.azimuths.astype(np.float64)
        e = np.zeros_like(r) if self.elevations is None else self.elevations.astype(np.float64)
        return np.column_stack([r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), r * np.sin(e)])
