"""The Victoria Park dataset as a source: a truck's odometry and the trees that it saw."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import LandmarkSightings, Message, Odometry
from dataflow.messages.geometry import quaternion_from_yaw
from dataflow.operator import Out, Param, Source, SourceError

Array = NDArray[np.float64]
_PLANAR = [0, 1, 5]


@dataclass
class Step:
    """One pose of the file: the motion that led to it (x, y, turn) with covariance, and what was seen there."""

    motion: Array = field(default_factory=lambda: np.zeros(3))
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    ids: list[int] = field(default_factory=list)
    points: list[list[float]] = field(default_factory=list)
    spreads: list[list[list[float]]] = field(default_factory=list)


class VictoriaPark(Source):
    """Reads a text file of odometry steps and landmark sightings, as those of Victoria Park are distributed.

    Lines are `ODOMETRY i j dx dy dturn` and `LANDMARK i k x y`, each followed by the upper triangle of its covariance,
    row by row. Poses follow one another; the file has no times, so a pose comes every `period`. A pose's twist
    covariance is that of the step that led to it.

    No truth comes with it: the file holds odometry and sightings alone. Where the truck was is known only by satellite
    fixes that the original logs have for parts of the way; the trees were never surveyed. Estimates are compared
    with the optimum over all measurements of the file, which another solver finds.
    """

    odometry: Out[Odometry] = Out(doc="dead reckoning, with the twist and the covariance of each step")
    sightings: Out[LandmarkSightings] = Out(doc="landmarks seen from a pose, Cartesian in the robot's frame")

    path: str = Param(doc="the file")
    period: float = Param(0.2, gt=0, doc="time from pose to pose", unit="s")
    first_stamp: int = Param(0, ge=0, doc="stamp of the first pose", unit="ns")
    base_frame: str = Param("base_link", min_length=1, doc="the robot's frame")
    odometry_frame: str = Param("odom", min_length=1, doc="frame of the dead reckoning")

    def setup(self) -> None:
        """Raises SourceError."""
        file = Path(self.path).expanduser()
        self.use_file(file)
        self._steps = read_steps(file)

    def length(self) -> int:
        return len(self._steps)

    def stream(self) -> Iterator[Mapping[str, Message]]:
        position, heading = np.zeros(2), 0.0
        for number, step in enumerate(self._steps):
            stamp = self.first_stamp + round(number * self.period * 1e9)
            c, s = math.cos(heading), math.sin(heading)
            position = position + np.array([[c, -s], [s, c]]) @ step.motion[:2]
            heading += float(step.motion[2])
            spread = np.zeros((6, 6))
            spread[np.ix_(_PLANAR, _PLANAR)] = step.covariance / self.period**2
            messages: dict[str, Message] = {
                "odometry": Odometry(
                    stamp=stamp,
                    frame=self.odometry_frame,
                    child_frame=self.base_frame,
                    position=np.array([*position, 0.0]),
                    orientation=quaternion_from_yaw(heading),
                    linear=np.array([*step.motion[:2], 0.0]) / self.period,
                    angular=np.array([0.0, 0.0, step.motion[2]]) / self.period,
                    twist_covariance=spread,
                )
            }
            if step.ids:
                messages["sightings"] = LandmarkSightings(
                    stamp=stamp,
                    frame=self.base_frame,
                    ids=np.array(step.ids, np.int64),
                    positions=np.array(step.points),
                    covariances=np.array(step.spreads),
                )
            yield messages


def read_steps(file: Path) -> list[Step]:
    """Reads all poses of a file, in their order. Raises SourceError, OSError."""
    following: dict[int, int] = {}
    steps: dict[int, Step] = {}
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        try:
            kind, first, second = words[0], int(words[1]), int(words[2])
            values = [float(word) for word in words[3:]]
            if kind == "ODOMETRY" and len(values) == 9:
                following[first] = second
                step = steps.setdefault(second, Step())
                step.motion, step.covariance = np.array(values[:3]), _symmetric(values[3:], 3)
                steps.setdefault(first, Step())
            elif kind == "LANDMARK" and len(values) == 5:
                step = steps.setdefault(first, Step())
                step.ids.append(second)
                step.points.append(values[:2])
                step.spreads.append(_symmetric(values[2:], 2).tolist())
            else:
                raise ValueError(f"{kind} with {len(values)} numbers")
        except (ValueError, IndexError) as error:
            raise SourceError(
                f"{file}, line {number}: {error}; expected `ODOMETRY i j dx dy dturn` and 6 numbers of covariance, or "
                "`LANDMARK i k x y` and 3"
            ) from None
    beginnings = sorted(set(following) - set(following.values()))
    if len(beginnings) != 1:
        raise SourceError(f"{file}: its poses are not one chain; it begins at {beginnings or 'no pose'}")
    ordered, pose = [steps[beginnings[0]]], beginnings[0]
    while pose in following:
        pose = following[pose]
        ordered.append(steps[pose])
    return ordered


def _symmetric(upper: list[float], size: int) -> Array:
    C = np.zeros((size, size))
    C[np.triu_indices(size)] = upper
    return C + C.T - np.diag(np.diag(C))
