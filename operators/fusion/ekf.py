"""Operator for the state of a robot from all its sensors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Diagnostics,
    Imu,
    LandmarkSightings,
    MagneticField,
    Message,
    NavSatFix,
    Odometry,
    Pose,
    RadarScan,
    Transforms,
    Twist,
)
from dataflow.operator import Context, In, Operator, Out, Param, Sampled
from operators.fusion.alarms import Alarms
from operators.fusion.filter.error_state import Noise
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.gate import GateConfig
from operators.fusion.filter.history import Command
from operators.fusion.filter.imu_dropout import ImuDropout
from operators.fusion.filter.initialisation import COASTING, Prior, coasting_node, prior_of
from operators.fusion.filter.measurements import Measurement
from operators.fusion.filter.suspicions import LATE
from operators.fusion.output import (
    diagnostics,
    figures,
    odometry_of,
    suspicion_of,
    unmeasured,
    unsure_of_time,
    well_known,
)
from operators.fusion.sensors.constraints import Constraints
from operators.fusion.sensors.covariances import UnusableMessage
from operators.fusion.sensors.inertial import InertialConfig, InertialSensor
from operators.fusion.sensors.interpretation import MeasurementContext, measurements, turning
from operators.fusion.sensors.last_measurements import LastMeasurements
from operators.fusion.sensors.lever_arms import LeverArms
from operators.fusion.sensors.settings import SensorSettings, errors_of, name_of, never_yields, unheard, use_of

Array = NDArray[np.float64]
_DEFAULT = SensorSettings()
_ANEW = 2_000_000_000
"""Nanoseconds for which a filter that began anew is reported."""


@dataclass(kw_only=True)
class State:
    """Holds the filter, what is known of each sensor, and the names of those whose gate never yields."""

    inertial: InertialSensor
    dropout: ImuDropout
    constraints: Constraints
    lever_arms: LeverArms
    origin: tuple[float, float, float] | None
    strict: set[str] = field(default_factory=set)  # before the filter, which is made anew with their gates
    filter: ErrorStateFilter | None = None
    alarms: Alarms = field(default_factory=Alarms)
    last: LastMeasurements = field(default_factory=LastMeasurements)
    sure: bool = False
    ignored: Counter[str] = field(default_factory=Counter)


class EkfFusion(Operator):
    """Fuses inertial, satellite, odometry, pose, velocity, heading, radar and range measurements by an error-state EKF.

    The state is position, velocity, orientation and the biases of the inertial sensor. Inertial samples move it;
    without them (`motion: constant_velocity`) velocity and angular velocity stay but for noise, or follow a control
    input, a twist that is used as `control`. Everything else corrects it, at the time when it was measured: what comes
    late, up to `window`, is put in its place and the rest is done again.

    Settings of a stream stand under the end of its name (`robot/fix`); the status names those of no stream. A
    chi-square gate refuses what does not fit; measurements that fit only because the filter's covariance is large wait
    for a second one that agrees, and refused ones that agree for a second show the filter to be wrong, which makes room
    for them, unless they leapt and the inertial sensor felt nothing, or repeat a place bit for bit that the body has
    left; the status warns at once, also of a sensor none of whose messages is of use. Detections of a radar
    and ranges may be of something else, so the filter never yields to those. A radar counts by its Doppler velocities,
    or, as `range`, by its distances from landmarks that its `ids` name.

    A sensor's time offset is a setting, `offset`; with `offset_sigma` it is a state of the filter and estimated, as far
    as the motion makes it observable. So are a position's error that changes slowly, as satellites have (`drift`), and
    the scale of wheels (`scale_sigma`): taken for white noise, these would make the covariance too small. Late stamps
    of places and speeds of a wrong scale that were not told are looked for in the last 20 s, and warned of; what
    stamps are late is taken off, and the covariance holds how little it is known.

    `standstill` and `slip` say what is known of the motion without a sensor of it (wheels say both by themselves).
    It begins when the inertial sensor has rested for `rest` and no position or speed shows otherwise, or after
    `patience` in motion: gravity gives the level, rest the gyroscope's bias. With `start: unknown` position and
    heading come from the measurements; headings all around are tried side by side until one is left, and the
    covariance holds them all. With `start: origin` the first pose is the world frame. Odometry begins when the
    position is known (`sure`).

    Methods: Solà, "Quaternion kinematics for the error-state Kalman filter", 2017; Li and Mourikis, "Online temporal
    calibration for camera-IMU systems", 2014.
    """

    measurements: In[Imu | NavSatFix | Pose | Odometry | Twist | MagneticField | RadarScan | LandmarkSightings] = In(
        many=True, doc="the streams of all sensors"
    )
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="where the sensors are on the robot; those it does not name are at the base"
    )
    landmark_map: Sampled[LandmarkSightings] = Sampled(required=False, doc="where the landmarks of ranges are")
    odometry: Out[Odometry] = Out(doc="the base in the world frame, with velocity and covariance; with every sample")
    status: Out[Diagnostics] = Out(doc="what became of each sensor's measurements; every second")

    sensors: dict[str, SensorSettings] = Param(
        {}, doc="settings by stream, such as robot/fix; the others have defaults"
    )
    motion: Literal["inertial", "constant_velocity"] = Param("inertial", doc="what moves the state")
    start: Literal["unknown", "origin"] = Param("unknown", doc="what is known of the first position and heading")
    heading: float | None = Param(
        None, doc="first heading of the base, if known though the position is not", unit="rad"
    )
    heading_sigma: float = Param(0.1, gt=0, doc="its standard deviation", unit="rad")
    world_frame: str = Param("world", min_length=1, doc="frame of the estimate and of absolute poses; z up")
    base_frame: str = Param("base_link", min_length=1, doc="frame that is posed")
    origin: tuple[float, float, float] | None = Param(
        None, doc="latitude, longitude, altitude of the world frame's origin, x east; the first fix if none"
    )
    gravity: float = Param(9.80665, gt=0, doc="strength of gravity", unit="m/s²")
    gyro_noise: float | None = Param(
        None, gt=0, doc="density of the gyroscope's noise; the samples' covariance if none", unit="rad/s/√Hz"
    )
    accel_noise: float | None = Param(
        None, gt=0, doc="density of the accelerometer's; the samples' covariance if none", unit="m/s²/√Hz"
    )
    gyro_walk: float = Param(2e-5, ge=0, doc="random walk of the gyroscope's bias", unit="rad/s²/√Hz")
    accel_walk: float = Param(3e-4, ge=0, doc="random walk of the accelerometer's bias", unit="m/s³/√Hz")
    gyro_bias: float = Param(0.02, gt=0, doc="standard deviation of the gyroscope's first bias", unit="rad/s")
    accel_bias: float = Param(0.2, gt=0, doc="standard deviation of the accelerometer's first bias", unit="m/s²")
    free_acceleration: float = Param(1.0, gt=0, doc="noise of the velocity without inertial samples", unit="m/s²/√Hz")
    free_turning: float = Param(0.5, gt=0, doc="noise of the angular velocity without samples", unit="rad/s²/√Hz")
    rest: float = Param(0.5, gt=0, doc="rest that the filter begins with", unit="s")
    patience: float = Param(3.0, ge=0, doc="time after which it begins in motion", unit="s")
    sure: float = Param(1.0, gt=0, doc="odometry begins when the position is known so well", unit="m")
    window: float = Param(1.0, gt=0, doc="how late measurements may come", unit="s")
    max_gap: float = Param(0.1, gt=0, doc="time without inertial samples after which motion is unknown", unit="s")
    standstill: float | None = Param(None, gt=0, doc="forces straying less for half a second are rest", unit="m/s²")
    slip: float | None = Param(None, gt=0, doc="deviation of the velocity aside and upwards of what rolls", unit="m/s")

    state: State

    def setup(self) -> None:
        self._gates: dict[str, GateConfig] = {}

    def initial_state(self) -> State:
        inertial = InertialConfig(
            self.gyro_noise, self.accel_noise, self.gyro_walk, self.accel_walk, self.rest, self.patience
        )
        return State(
            inertial=InertialSensor(inertial),
            dropout=ImuDropout(self.max_gap, self.gravity, self._unknown()),
            constraints=Constraints(self.standstill, self.slip),
            lever_arms=LeverArms(self.base_frame, "" if self.motion == "inertial" else self.base_frame),
            origin=self.origin,
        )

    def new_part(self, kind: type[Any]) -> ErrorStateFilter:
        return ErrorStateFilter(self._config(), coasting_node(0, self._prior(), self.gravity))

    def process(
        self,
        measurements: Mapping[str, Message],
        context: Context,
        extrinsics: Transforms | None = None,
        landmark_map: LandmarkSightings | None = None,
    ) -> dict[str, Any] | None:
        """Raises ValueError for a message that its settings do not fit, or that has no place on the robot."""
        self.state.lever_arms.given(extrinsics)
        self.state.last.hear(measurements)
        named = {
            name: m
            for stream, m in measurements.items()
            if self._follows(name := name_of(stream, self.sensors), m.stamp)
        }
        felt = False
        for name, message in named.items():
            settings = self._settings(name)
            if isinstance(message, Imu) and use_of(name, message, settings) == "inertial":
                felt = self._feel(name, message, settings)
        around = MeasurementContext(
            self.state.lever_arms.of, self.world_frame, self.state.origin, landmark_map, self.state.ignored
        )
        for name, message in named.items():
            if not (isinstance(message, Imu) and use_of(name, message, self._settings(name)) == "inertial"):
                self._measure(name, message, around)
        self.state.origin = around.origin
        if self.state.filter is None or not (felt or self.motion == "constant_velocity" or self._bridge(context.stamp)):
            return None
        self.state.filter.look()
        return {"odometry": self._odometry(context.stamp), "status": self._status(context.stamp)}

    def summary(self) -> Mapping[str, float | int | str]:
        fused = self.state.filter
        health = {} if fused is None else fused.health
        ignored = self.state.ignored + (Counter() if fused is None else fused.ignored)
        return figures(health, self._offsets(), dict(self._unheard()), ignored)

    @property
    def _filter(self) -> ErrorStateFilter:
        assert self.state.filter is not None
        return self.state.filter

    def _follows(self, name: str, stamp: int) -> bool:
        """Returns whether a message comes after the sensor's last; one that does not is counted."""
        if self.state.last.follows(name, stamp):
            return True
        self.state.ignored[f"{name}: stamp not later than the last"] += 1
        return False

    def _offsets(self) -> dict[str, tuple[float, float]]:
        """The time offset of each sensor that has it estimated, in all, and its standard deviation, s."""
        found = {} if self.state.filter is None else self.state.filter.offsets()
        return {name: (self._settings(name).offset + at, sigma) for name, (at, sigma) in found.items()}

    def _settings(self, name: str) -> SensorSettings:
        return self.sensors.get(name, _DEFAULT)

    def _config(self) -> FilterConfig:
        inertial = self.motion == "inertial"
        strict = {name: self._settings(name).gate("range") for name in sorted(self.state.strict)}
        self._gates = self.state.constraints.gates | {name: s.gate(s.use) for name, s in self.sensors.items()} | strict
        return FilterConfig(
            window=self.window,
            gravity=self.gravity,
            max_gap=self.max_gap,
            inertial=inertial,
            unknown=self._unknown(),
            gates=self._gates,
            errors=errors_of(self.sensors),
            unfelt=self._prior().unfelt(self.gravity) if inertial else None,
            biases=(self.gyro_bias, self.accel_bias) if inertial else COASTING,
        )

    def _unknown(self) -> Noise:
        """The process noise of a motion without inertial sensor."""
        if self.motion == "inertial":
            return Noise(self.free_turning, self.free_acceleration, self.gyro_walk, self.accel_walk)
        return Noise(0.0, self.free_acceleration, self.free_turning, 0.0)

    def _bridge(self, stamp: int) -> bool:
        """Takes the inertial sensor's place where it is silent; False where it is not."""
        if not self.state.dropout.lasts(stamp):
            return False
        self._filter.feel(self.state.dropout.sample(stamp, self._filter.estimate(stamp)[0]))
        return True

    def _prior(self) -> Prior:
        at_origin = self.start == "origin"
        return prior_of(at_origin, self.heading, self.heading_sigma, self.gyro_bias, self.accel_bias)

    def _feel(self, name: str, imu: Imu, settings: SensorSettings) -> bool:
        """Takes an inertial sample; False where it is ignored."""
        if self.motion == "constant_velocity":
            self.state.ignored[f"{name}: motion is constant_velocity"] += 1
            return False
        if self.state.lever_arms.body not in ("", imu.frame):
            raise ValueError(
                f"{name}: a second inertial sensor, {imu.frame!r} beside "
                f"{self.state.lever_arms.body!r}: only one can move"
            )
        if settings.offset_sigma:
            raise ValueError(f"{name}: its clock is the one that offsets are related to: it has no offset_sigma")
        try:
            sample = self.state.inertial.sample(name, imu, imu.stamp - round(settings.offset * 1e9))
        except UnusableMessage as reason:
            self.state.ignored[f"{name}: {reason}"] += 1
            return False
        self.state.lever_arms.body = imu.frame
        self.state.dropout.felt(sample.time)
        if self.state.filter is not None:
            self.state.filter.feel(sample)
            for sensor, model, noise in self.state.constraints.after(sample, self.state.lever_arms.of(self.base_frame)):
                self.state.filter.measure(Measurement(sample.time, sensor, model, noise))
            return True
        begun = self.state.inertial.begun(
            sample, self._prior(), self.gravity, self.state.lever_arms.of(self.base_frame)
        )
        if begun is None:
            return False
        self.state.filter = ErrorStateFilter(self._config(), begun[0])
        self.state.ignored["begun in motion"] += int(not begun[1])
        return True

    def _measure(self, name: str, message: Message, around: MeasurementContext) -> None:
        if self.state.filter is None and self.motion == "constant_velocity":
            start = coasting_node(message.stamp, self._prior(), self.gravity)
            self.state.filter = ErrorStateFilter(self._config(), start)
        settings = self._settings(name)
        if never_yields(gate := settings.gate(use_of(name, message, settings))):  # by the setting, or by its type
            self.state.strict.add(name)
            self._gates[name] = gate
        before = self.state.last.before(name, message)
        if self.state.filter is None:
            self.state.ignored[f"{name}: before the beginning"] += 1
            with suppress(UnusableMessage):
                for found in measurements(name, message, before, settings, around):
                    self.state.inertial.saw(*found)
            return
        if settings.use == "control":
            self._command(name, message, settings, around)
            return
        clock, assumed = self._clock(name)
        if (seen := turning(message, before, around)) is not None:
            self.state.dropout.saw(message.stamp, seen)
        try:
            for time, sensor, model, noise in measurements(name, message, before, settings, around):
                taken = assumed if clock >= 0 else self._late(sensor)
                self.state.filter.measure(Measurement(time - taken, sensor, model, noise, clock, taken * 1e-9))
            self.state.alarms.of_use(name)
        except UnusableMessage as reason:
            self.state.ignored[f"{name}: {reason}"] += 1
            self.state.alarms.of_no_use(name, str(reason))

    def _clock(self, name: str) -> tuple[int, int]:
        """Returns a sensor's clock in the filter, -1 for none, and the offset (ns) that it is believed to have."""
        offsets = self._filter.offsets()
        return (list(offsets).index(name), round(offsets[name][0] * 1e9)) if name in offsets else (-1, 0)

    def _late(self, sensor: str) -> int:
        """Returns by how much (ns) a sensor's stamps are found to be late, beyond their settings."""
        found = self._filter.suspicion
        if found is None or found[:2] != (sensor, LATE) or abs(found[2]) >= self.window:
            return 0
        return round(found[2] * 1e9)

    def _command(self, name: str, message: Message, settings: SensorSettings, around: MeasurementContext) -> None:
        assert isinstance(message, Twist)
        if self.motion == "inertial":
            self.state.ignored[f"{name}: a control input beside inertial samples"] += 1
        elif not (np.isfinite(message.linear).all() and np.isfinite(message.angular).all()):
            self.state.ignored[f"{name}: not finite"] += 1
        else:
            turn = around.place(message.frame)[:3, :3]
            time = message.stamp - round(settings.offset * 1e9)
            self._filter.command(Command(time, turn @ message.linear, turn @ message.angular, settings.lag))

    def _odometry(self, stamp: int) -> Odometry | None:
        state, rate = self._filter.estimate(stamp)
        self.state.sure = self.state.sure or well_known(state.covariance, self.sure)
        if not self.state.sure:
            return None
        found = self._filter.suspicion
        if found is not None and found[1] == LATE:
            state = unsure_of_time(state, rate, math.hypot(found[2] - 1e-9 * self._late(found[0]), found[3]))
        T_body_base = self.state.lever_arms.of(self.base_frame)
        return odometry_of(state, rate, T_body_base, stamp, self.world_frame, self.base_frame)

    def _status(self, stamp: int) -> Diagnostics | None:
        health, ignored = self._filter.health, self.state.ignored + self._filter.ignored
        others = {}
        if (count := self._filter.hypotheses) > 1:
            others["filter"] = f"{count} headings in question"
        if self._filter.doubted_heading:
            others["heading"] = "the first heading that was told may be wrong: others explain as much"
        if self._filter.refuted_heading:
            others["heading"] = "the first heading that was told is wrong: measurements contradict it"
        if stamp - self._filter.restarted < _ANEW:
            others["filter"] = "begun anew: what was felt and measured of late contradicts the rotation"
        if (found := self._filter.suspicion) is not None:
            others |= suspicion_of(*found)
        if self._lies():
            others["level"] = (
                "a base that rolls lies on its side by gravity: axes or extrinsics of the inertial sensor?"
            )
        if self.state.dropout.lasts(stamp):
            others["inertial sensor"] = "silent: the motion is bridged by what others see"
        if (warnings := self.state.alarms.due(stamp, health, self._filter.ignored, self._gates, others)) is None:
            return None
        warnings |= {f"settings of {name}": f"no stream so far has this name{near}" for name, near in self._unheard()}
        warnings |= unmeasured(self._filter.estimate(stamp)[0].covariance)
        return diagnostics(stamp, health, ignored, self._offsets(), warnings)

    def _lies(self) -> bool:
        """Returns whether a base on wheels is tilted by more than a slope may be, 60 degrees."""
        if self.slip is None and all(s.use != "wheels" for s in self.sensors.values()):
            return False
        R_world_body = self._filter.estimate(self._filter.time)[0].rotation
        return bool((R_world_body @ self.state.lever_arms.of(self.base_frame)[:3, :3])[2, 2] < 0.5)

    def _unheard(self) -> list[tuple[str, str]]:
        return list(unheard(tuple(self.sensors), sorted(self.state.last.streams)).items())
