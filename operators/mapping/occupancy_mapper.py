"""A grid of free and taken floor for navigation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dataflow.messages import Diagnostics, Message, OccupancyGrid, Odometry, PointCloud, Pose, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.mapping.occupancy import ColumnGrid, GridSettings
from operators.mapping.placing import placed
from operators.status import counted_status


@dataclass(kw_only=True)
class State(Counts):
    """Holds the map and its frame, empty before the first pose."""

    grid: ColumnGrid
    frame: str = ""


class OccupancyMapper(Operator):
    """Maps which cells of the floor are free, from clouds of a depth camera or a LiDAR and the poses of their sensor.

    Rays are cast to the points through columns of cubes, so that what is seen over and under a table does not free its
    cell; a cell is as full as the fullest cube that was seen of its column between `lower` and `upper`. Where a cloud
    has `time_offsets` and the pose a velocity, the cloud is deskewed. The map has the frame of the poses, whose z is
    up; it does not follow later corrections of them.

    Method: Moravec and Elfes, "High resolution maps from wide angle sonar", 1985, with the bounded log-odds of Hornung
    et al., "OctoMap", 2013.
    """

    cloud: In[PointCloud] = In(doc="points in the frame of their sensor, which is the origin")
    pose: In[Pose | Odometry] = In(doc="the sensor or its robot in a frame whose z is up, at the cloud's stamp")
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the cloud's frame and that of the pose, where they differ"
    )
    map: Out[OccupancyGrid] = Out(doc="the map so far: 0 free, 100 taken, -1 unknown")
    status: Out[Diagnostics] = Out(doc="points and cells; a warning for a cloud or a pose that is unusable")

    resolution: float = Param(0.05, gt=0.005, doc="side of a cell", unit="m")
    layer: float = Param(
        0.025, gt=0.005, doc="height of a cube; a table top that is seen from its edge needs low ones", unit="m"
    )
    lower: float = Param(0.05, doc="lowest height in the poses' frame that is in the robot's way", unit="m")
    upper: float = Param(1.5, doc="highest such height", unit="m")
    floor_growth: float = Param(
        0.002, ge=0, doc="this times the squared range is added to `lower`: a far floor is noisy", unit="1/m"
    )
    near: float = Param(0.3, ge=0, doc="nearer points are the robot itself", unit="m")
    far: float = Param(
        8.0,
        gt=0,
        doc="farther points are not entered, rays to them free what they pass; as far as noise is below half a cell",
        unit="m",
    )
    hit: float = Param(1.0, gt=0, doc="log-odds that a point adds to its cube")
    miss: float = Param(0.35, gt=0, doc="log-odds that a ray takes from the cubes that it passes")
    bound: float = Param(3.5, gt=0, le=20, doc="most that is remembered, in log-odds: less forgets movers faster")
    period: int = Param(5, ge=1, tunable=True, doc="the map comes with every so many clouds")
    most_cubes: int = Param(100_000_000, ge=1, doc="the largest map; a larger one ends the run")
    state: State

    def setup(self) -> None:
        """Raises ValueError for a band or a range that holds nothing."""
        if self.lower >= self.upper:
            raise ValueError(f"lower {self.lower} m must be below upper {self.upper} m")
        if self.near >= self.far:
            raise ValueError(f"near {self.near} m must be below far {self.far} m")

    def initial_state(self) -> State:
        settings = GridSettings(
            resolution=self.resolution,
            layer=self.layer,
            band=(self.lower, self.upper),
            growth=self.floor_growth,
            near=self.near,
            far=self.far,
            hit=self.hit,
            miss=self.miss,
            bound=self.bound,
            most_cubes=self.most_cubes,
        )
        return State(grid=ColumnGrid(settings))

    def process(
        self, cloud: PointCloud, pose: Pose | Odometry, extrinsics: Transforms | None = None
    ) -> dict[str, Message]:
        """Raises ValueError where no transform relates cloud and pose, where the poses' frame changes, and where the
        map would have more than `most_cubes`."""
        if self.state.frame and pose.frame != self.state.frame:
            raise ValueError(f"the map is in frame {self.state.frame!r}, but the pose in {pose.frame!r}")
        self.state.frame = pose.frame
        seen = placed(cloud, pose, extrinsics)
        used = 0 if seen is None else self.state.grid.insert(seen.origin, seen.points)
        reason = ""
        if seen is None:
            reason = "the pose is not finite"
        elif not used:
            reason = "no point is usable" if cloud.count else "the cloud is empty"
        self.state.counts.update({"clouds": 1, "clouds left out": bool(reason), "points": used})
        counts = {"points": cloud.count, "points used": used}
        level = Level.WARN if reason else Level.OK
        status = counted_status("occupancy_mapper", cloud.stamp, reason or f"{used} points", level, counts)
        messages: dict[str, Message] = {"status": status}
        if self.state.counts["clouds"] % self.period == 0:
            messages["map"] = self._map(cloud.stamp)
        return messages

    def summary(self) -> Mapping[str, float | int]:
        cells, _ = self.state.grid.plan()
        area = self.resolution**2
        return dict(self.state.counts) | {
            "free m²": round(float(((cells >= 0) & (cells < 50)).sum()) * area, 2),
            "taken m²": round(float((cells >= 50).sum()) * area, 2),
        }

    def _map(self, stamp: int) -> OccupancyGrid:
        cells, corner = self.state.grid.plan()
        return OccupancyGrid(
            stamp=stamp,
            frame=self.state.frame,
            resolution=self.resolution,
            cells=cells,
            position=np.array([*corner, 0.0]),
        )
