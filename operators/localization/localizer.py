"""Localisation by particles in a known map as an operator."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Boxes3D,
    Diagnostics,
    Imu,
    LandmarkSightings,
    LaserScan,
    Message,
    NavSatFix,
    OccupancyGrid,
    Odometry,
    ParticleSet,
    PointCloud,
    Pose,
    Transforms,
)
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import invert
from dataflow.operator import Duration, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.geometry.planar import flat, placed_in, planar
from operators.localization.dead_reckoning import DeadReckoning
from operators.localization.interpretation import MODALITIES, LocalizationContext, UnusableMessage, observation
from operators.localization.likelihood_field import LikelihoodField
from operators.localization.map_file import read_map
from operators.localization.motion import DriveNoise
from operators.localization.particle_filter import CloudConfig
from operators.localization.sensor_weights import CONSISTENT
from operators.localization.weighted_cloud import Estimate, WeightedCloud, contradict
from operators.status import Row, status_of_rows

_LEVELS = {
    "localised": Level.OK,
    "ambiguous": Level.WARN,
    "searching": Level.WARN,
    "waiting": Level.WARN,
    "lost": Level.ERROR,
}
Array = NDArray[np.float64]


def written(pose: Array) -> str:
    """Returns a pose (3,) as text."""
    x, y, yaw = pose
    return f"{x:.3f} {y:.3f} {yaw:.3f}"


def status_of(
    stamp: int,
    fused: Estimate,
    filter: WeightedCloud,
    modalities: Mapping[str, WeightedCloud],
    ignored: Mapping[str, int],
) -> Diagnostics:
    """Returns a status for the filter, one for every sensor, and one for every modality beside the fused estimate."""
    figures = {**filter.figures(), "share in one place": f"{fused.share:.2f}", "injected": str(filter.injected)}
    if fused.other is not None:
        figures |= {"other place": written(fused.other), "likelier than the other": f"{filter.competing.lead:.1f} nats"}
    figures |= {f"ignored, {reason}": str(count) for reason, count in sorted(ignored.items())}
    said = "ambiguous: another place explains as much" if fused.other is not None else fused.word
    rows: list[Row] = [("filter", said, _LEVELS[fused.word], figures)]
    counts = filter.sensor_weights.counts(stamp)
    for sensor, fit in sorted(filter.fits().items()):
        ratio, count = filter.sensor_weights.ratio(sensor), counts.get(sensor, 1.0)
        text = "consistent" if ratio <= CONSISTENT else "innovations larger than usual"
        if count < 1:
            text = "disagrees with the others and counts less"
        level = Level.OK if ratio <= CONSISTENT else Level.WARN
        rows.append(
            (sensor, text, level, {"counts": f"{count:.3f}", "innovations": f"{ratio:.2f}", "fit": f"{fit:.2f}"})
        )
    for name, vote in modalities.items():
        if vote.begun:
            own = vote.estimate()
            off = contradict(own, fused)
            text = "contradicts the fused estimate" if off else own.word
            places = {"pose": written(own.mean)} | ({} if own.other is None else {"other place": written(own.other)})
            rows.append((f"{name} alone", text, Level.WARN if off else Level.OK, places))
    return status_of_rows(stamp, rows)


@dataclass(kw_only=True)
class State:
    """Holds the clouds, and the messages (stamp, stream) that wait for the next odometry: their time comes then."""

    fused: WeightedCloud
    modalities: dict[str, WeightedCloud]
    reckoning: DeadReckoning
    pending: list[tuple[int, str, Message]] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    reported: int = -1
    shown: int = -1
    word: str = ""


class ParticleFilterLocalizer(Operator, merge=True):
    """Finds and follows a robot in a known map by particles (x, y, yaw), from several sensors at once.

    Odometry, with a gyroscope for its turns, moves the particles. They are weighed by lidar scans against the map's
    likelihood field, by landmarks (with or without identities) and classified objects against maps of these, and by
    positions. Without a first pose they begin where the first observation puts them. When observations fit worse than
    they used to, samples that would explain them are injected, so a robot that was carried away is found again. Their
    number follows the spread of the cloud (KLD sampling); it is drawn anew by systematic resampling.

    A sensor whose innovations are larger than its noise explains, while another sensor's are not, counts less, and the
    status reports it. Beside the fused cloud every modality has a separate cloud, with the same motion.

    Poses come while the robot is localised: most of the weight lies in one place, observations fit there, and nowhere
    else. A robot that has been found is looked for elsewhere too; while another place explains the observations about
    as well (a mirrored corridor), it is ambiguous, the status names both, and no pose is given. Sensors are taken at
    their own stamps, between the odometry messages around them.

    Methods: Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, chapter 8 (augmented Monte Carlo localisation);
    Fox, "Adapting the sample size in particle filters through KLD-sampling", 2003; Jensfelt and Kristensen, "Active
    global localization for a mobile robot using multiple hypothesis tracking", 2001.
    """

    odometry: In[Odometry] = In(doc="planar motion: increments between messages count, the pose itself does not")
    measurements: In[PointCloud | LaserScan | LandmarkSightings | Boxes3D | Pose | NavSatFix | Imu] = In(
        many=True,
        doc="lidar, landmarks seen, objects seen, positions in the map frame; and an inertial sensor, which gives the "
        "turns in place of the odometry",
    )
    extrinsics: Sampled[Transforms] = Sampled(required=False, doc="where the sensors are on the robot")
    map: Sampled[OccupancyGrid] = Sampled(required=False, doc="the map for lidar; see also map_file")
    landmark_map: Sampled[LandmarkSightings] = Sampled(required=False, doc="where the landmarks are")
    object_map: Sampled[Boxes3D] = Sampled(required=False, doc="where objects that stand still are")
    pose: Out[Odometry] = Out(doc="the base in the map with covariance, at every odometry message while localised")
    correction: Out[Transforms] = Out(doc="the odometry frame in the map frame (REP 105), with every pose")
    particles: Out[ParticleSet] = Out(doc="the fused cloud")
    lidar_pose: Out[Odometry] = Out(doc="estimate by lidar alone, while its cloud is in one place")
    landmark_pose: Out[Odometry] = Out(doc="estimate by landmarks and objects alone")
    position_pose: Out[Odometry] = Out(doc="estimate by positions alone")
    status: Out[Diagnostics] = Out(
        doc="localised, ambiguous, searching or lost, and what each sensor counts; every second"
    )

    map_frame: str = Param("world", min_length=1, doc="frame of the maps and of the pose")
    base_frame: str = Param("base_link", min_length=1, doc="frame that is posed, on the floor")
    map_file: str | None = Param(None, doc="saved map (YAML and image, as ROS's map_server has them), if no stream")
    start: tuple[float, float, float] | None = Param(None, doc="first x, y, yaw (m, rad); looked for if none")
    start_sigma: tuple[float, float] = Param((0.3, 0.2), doc="standard deviations of the first pose, m and rad")
    min_particles: int = Param(200, ge=20, doc="particles at least")
    max_particles: int = Param(1000, ge=50, doc="particles at most; so many wherever the robot is looked for")
    modality_particles: int = Param(300, ge=0, doc="particles of each modality's own cloud; 0 for no such clouds")
    kld_error: float = Param(0.05, gt=0, lt=1, doc="error of the distribution that sets the number of particles")
    points: int = Param(60, ge=8, doc="points of a scan that are looked up")
    worth: float = Param(15.0, gt=0, doc="independent ones among them")
    hit_sigma: float = Param(0.08, gt=0, doc="standard deviation of a point from its taken cell", unit="m")
    stray: float = Param(0.15, gt=0, lt=1, doc="share of points that are of nothing in the map")
    band: tuple[float, float] = Param((0.1, 1.4), doc="heights between which points count, m")
    own: float = Param(0.4, ge=0, doc="points nearer than this are the robot itself", unit="m")
    object_sigma: float = Param(0.15, gt=0, doc="standard deviation of objects without covariance", unit="m")
    origin: tuple[float, float, float] | None = Param(
        None, doc="latitude, longitude, altitude of the map's origin, x east; for satellite fixes"
    )
    noise: DriveNoise = Param(DriveNoise(), doc="what the odometry is worth")
    cloud_every: Duration = Param("200ms", doc="time between two messages of the cloud")

    state: State

    def setup(self) -> None:
        """Reads the saved map. Raises ValueError for parameters that contradict each other or a file that is no map."""
        if self.min_particles > self.max_particles:
            raise ValueError(f"min_particles {self.min_particles} is above max_particles {self.max_particles}")
        self._grid: OccupancyGrid | None = None
        self._field: LikelihoodField | None = None
        if self.map_file is not None:
            path = self.use_file(self.map_file)
            self._take_map(read_map(Path(path), self.map_frame))

    def initial_state(self) -> State:
        config = CloudConfig(least=self.min_particles, most=self.max_particles, error=self.kld_error)
        own = CloudConfig(least=self.modality_particles, most=self.modality_particles)
        kinds = sorted(set(MODALITIES.values())) if self.modality_particles else []
        modalities = {kind: WeightedCloud(own) for kind in kinds}
        return State(fused=WeightedCloud(config), modalities=modalities, reckoning=DeadReckoning(self.noise))

    def process(
        self,
        odometry: Odometry | None,
        measurements: Mapping[str, Message],
        extrinsics: Transforms | None = None,
        map: OccupancyGrid | None = None,
        landmark_map: LandmarkSightings | None = None,
        object_map: Boxes3D | None = None,
    ) -> dict[str, Any] | None:
        """Raises ValueError for maps or measurements of another frame, and for sensors without place or covariance."""
        if map is not None and map is not self._grid:
            self._take_map(map)
        for name, message in sorted(measurements.items()):
            if isinstance(message, Imu):
                T = transform_between(extrinsics, message.frame, self.base_frame)
                rate = float(T[2, :3] @ message.angular_velocity)  # about the robot's z axis
                if math.isfinite(rate):
                    self.state.reckoning.feel(message.stamp, rate)
                else:
                    self.state.ignored[f"{name.partition('/')[2]}: not finite"] += 1
            else:
                self.state.pending.append((message.stamp, name.partition("/")[2], message))
        if odometry is None or not self._moves(odometry):
            return None
        around = LocalizationContext(
            self.base_frame,
            self.map_frame,
            extrinsics,
            self._field,
            landmark_map,
            object_map,
            self.origin,
            self.band,
            self.points,
            self.worth,
            self.own,
            self.object_sigma,
        )
        self._advance(odometry, around)
        return self._outputs(odometry)

    def summary(self) -> Mapping[str, float | int | str]:
        figures: dict[str, float | int | str] = {f"poses {word}": n for word, n in sorted(self.state.states.items())}
        figures["particles injected"] = self.state.fused.injected
        figures["turns on which wheels and gyroscope disagree"] = self.state.reckoning.disagreements
        return figures | {f"ignored, {reason}": count for reason, count in sorted(self.state.ignored.items())}

    def _take_map(self, grid: OccupancyGrid) -> None:
        if grid.frame != self.map_frame:
            raise ValueError(f"the map is in {grid.frame!r}, but the robot is looked for in {self.map_frame!r}")
        if not np.isfinite(grid.matrix()).all():
            raise ValueError(f"the map's place in {grid.frame!r} is not finite: {grid.position.tolist()}")
        self._grid, self._field = grid, LikelihoodField(grid, self.hit_sigma, self.stray)

    def _moves(self, odometry: Odometry) -> bool:
        """Returns whether odometry can be used; if not, it is counted, and the next one covers both steps."""
        if not (np.isfinite(odometry.position).all() and np.isfinite(odometry.orientation).all()):
            self.state.ignored["odometry: not finite"] += 1
            return False
        if self.state.reckoning.stamp is not None and odometry.stamp <= self.state.reckoning.stamp:
            self.state.ignored["odometry: stamp not later than the last"] += 1
            return False
        return True

    def _advance(self, odometry: Odometry, around: LocalizationContext) -> None:
        """Moves to an odometry message, with the measurements on the way."""
        if self.start is not None and not self.state.fused.begun:
            for vote in (self.state.fused, *self.state.modalities.values()):
                vote.begin_at(np.array(self.start), self.start_sigma, self.rng)
        due, self.state.pending = self.state.pending, []
        stepped = self.state.reckoning.step(odometry)
        done = 0.0
        for stamp, name, message in due:
            if stepped is not None:
                begin, step, covariance = stepped
                share = min(1.0, max(done, (stamp - begin) / (odometry.stamp - begin)))
                self._move(step, covariance, share - done)
                done = share
            self._observe(stamp, name, message, around)
        if stepped is not None:
            self._move(stepped[1], stepped[2], 1.0 - done)

    def _move(self, step: Array, covariance: Array, share: float) -> None:
        if share > 0:
            for vote in (self.state.fused, *self.state.modalities.values()):
                vote.move(step * share, covariance * share, self.rng)

    def _observe(self, stamp: int, name: str, message: Message, around: LocalizationContext) -> None:
        try:
            seen = observation(name, message, around)
        except UnusableMessage as reason:
            self.state.ignored[f"{name}: {reason}"] += 1
            return
        self.state.fused.update(name, stamp, seen, self.rng)
        if self.state.modalities:
            self.state.modalities[MODALITIES[type(message)]].update(name, stamp, seen, self.rng)

    def _outputs(self, odometry: Odometry) -> dict[str, Any]:
        stamp = odometry.stamp
        fused = self.state.fused.estimate()
        self.state.states[fused.word] += 1
        result: dict[str, Any] = {}
        if fused.word == "localised":
            result["pose"] = self._odometry(fused, odometry)
            result["correction"] = Transforms.from_matrix(
                planar(*fused.mean) @ invert(flat(odometry)),
                stamp=stamp,
                frame=self.map_frame,
                child_frame=odometry.frame,
            )
        for modality, port in (("lidar", "lidar_pose"), ("landmarks", "landmark_pose"), ("positions", "position_pose")):
            if modality in self.state.modalities:
                own = self.state.modalities[modality].estimate()
                if own.word == "localised":
                    result[port] = self._odometry(own, odometry)
        if self.state.fused.begun and (self.state.shown < 0 or stamp - self.state.shown >= self.cloud_every):
            self.state.shown = stamp
            poses, weights = self.state.fused.cloud()
            result["particles"] = ParticleSet(stamp=stamp, frame=self.map_frame, poses=poses, weights=weights)
        if self.state.reported < 0 or stamp - self.state.reported >= 10**9 or fused.word != self.state.word:
            self.state.reported, self.state.word = stamp, fused.word
            result["status"] = status_of(stamp, fused, self.state.fused, self.state.modalities, self.state.ignored)
        return result

    def _odometry(self, estimate: Estimate, odometry: Odometry) -> Odometry:
        T = planar(*estimate.mean)
        return placed_in(self.map_frame, self.base_frame, T, estimate.covariance, odometry)
