"""Operator for the state of a robot from all its sensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
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
from operators.fusion.filter.control import Command
from operators.fusion.filter.error_state import Noise
from operators.fusion.filter.history import Measurement
from operators.fusion.filter.imu_dropout import ImuDropout
from operators.fusion.filter.initialisation import Prior, coasting_node, prior_of
from operators.fusion.filter.late_filter import FilterConfig, LateFilter
from operators.fusion.output import diagnostics, figures, odometry_of, unmeasured, well_known
from operators.fusion.sensors.constraints import Constraints
from operators.fusion.sensors.covariances import Unusable
from operators.fusion.sensors.inertial import InertialConfig, InertialSensor
from operators.fusion.sensors.interpretation import Surroundings, measurements, turning
from operators.fusion.sensors.last_measurements import LastMeasurements
from operators.fusion.sensors.lever_arms import LeverArms
from operators.fusion.sensors.settings import SensorSettings, errors_of, name_of, never_yields, unheard, use_of

Array = NDArray[np.float64]
_DEFAULT = SensorSettings()


class EkfFusion(Operator):
    """Fuses inertial, satellite, odometry, pose, velocity, heading, radar and range measurements by an error-state EKF.

    The state is position, velocity, orientation and the biases of the inertial sensor. Inertial samples move it;
    without them (`motion: constant_velocity`) velocity and angular velocity stay but for noise, or follow a control
    input, a twist that is used as `control`. Everything else corrects it, at the time when it was measured: what comes
    late, up to `window`, is put in its place and the rest is done again.

    Settings of a stream stand under the end of its name (`robot/fix`); the status names those of no stream. A
    chi-square gate refuses what does not fit; measurements that fit only because the filter's covariance is large wait
    for a second one that agrees, and refused ones that agree for a second show the filter to be wrong, which makes room
    for them, unless they leapt and the inertial sensor felt nothing; the status warns at once. Detections of a radar
    and ranges may be of something else, so the filter never yields to those. A radar counts by its Doppler velocities,
    or, as `range`, by its distances from landmarks that its `ids` name.

    A sensor's time offset is a setting, `offset`; with `offset_sigma` it is a state of the filter and estimated, as far
    as the motion makes it observable. So are a position's error that changes slowly, as satellites have (`drift`), and
    the scale of wheels (`scale_sigma`): taken for white noise, these would make the covariance too small.

    `standstill` and `slip` say what is known of the motion without a sensor of it (wheels say both by themselves).
    It begins when the inertial sensor has rested for `rest`, or after `patience` in motion: gravity gives the level,
    rest the gyroscope's bias. With `start: unknown` position and heading come from the measurements; headings all
    around are tried side by side until one is left, and the covariance holds them all. With `start: origin` the first
    pose is the world frame. Odometry begins when the position is known (`sure`).

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

    def setup(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._filter: LateFilter | None = None
        self._inertial = InertialSensor(
            InertialConfig(self.gyro_noise, self.accel_noise, self.gyro_walk, self.accel_walk, self.rest, self.patience)
        )
        self._dropout = ImuDropout(self.max_gap, self.gravity, self._unknown())
        self._alarms = Alarms()
        self._origin, self._sure = self.origin, False
        self._ignored: Counter[str] = Counter()
        self._last = LastMeasurements()
        self._constraints = Constraints(self.standstill, self.slip)
        self._gates = self._constraints.gates | {name: s.gate(s.use) for name, s in self.sensors.items()}
        self._lever_arms = LeverArms(self.base_frame, "" if self.motion == "inertial" else self.base_frame)

    def process(
        self,
        measurements: Mapping[str, Message],
        context: Context,
        extrinsics: Transforms | None = None,
        landmark_map: LandmarkSightings | None = None,
    ) -> dict[str, Any] | None:
        """Raises ValueError for a message that its settings do not fit, or that has no place on the robot."""
        self._lever_arms.given(extrinsics)
        self._last.hear(measurements)
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
        around = Surroundings(self._lever_arms.of, self.world_frame, self._origin, landmark_map, self._ignored)
        for name, message in named.items():
            if not (isinstance(message, Imu) and use_of(name, message, self._settings(name)) == "inertial"):
                self._measure(name, message, around)
        self._origin = around.origin
        if self._filter is None or not (felt or self.motion == "constant_velocity" or self._bridge(context.stamp)):
            return None
        return {"odometry": self._odometry(context.stamp), "status": self._status(context.stamp)}

    def on_reset(self, input: str) -> None:
        """The clock of a stream began anew: so does the filter."""
        self._begin()

    def snapshot(self) -> Mapping[str, Any]:
        return {
            "filter": None if self._filter is None else self._filter.snapshot(),
            "inertial": self._inertial.snapshot(),
            "silence": self._dropout.snapshot(),
            "constraints": self._constraints.snapshot(),
            "alarms": self._alarms.snapshot(),
            "stamps": dict(self._last.stamps),
            "before": self._last.odometry_state(),
            "origin": None if self._origin is None else list(self._origin),
            "body": self._lever_arms.body,
            "sure": int(self._sure),
            "ignored": dict(self._ignored),
            "heard": sorted(self._last.streams),
            "strict": sorted(name for name, gate in self._gates.items() if never_yields(gate)),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        self._begin()
        for name in state.get("strict", ()):
            self._gates[name] = self._settings(name).gate("range")
        if state["filter"] is not None:
            self._filter = LateFilter.restored(self._config(), state["filter"])
        if "inertial" in state:
            self._inertial.restore(state["inertial"])
            self._alarms.restore(state.get("alarms", state))
        else:  # as snapshots were before the sensor kept its own part
            self._alarms.restore({"reported": state["stamps"][-1]})
            self._inertial.restore({"samples": state["samples"], "stamps": state["stamps"][:-1]})
        for name, part in (("silence", self._dropout), ("constraints", self._constraints)):
            if name in state:
                part.restore(state[name])
        last = state["stamps"] if "inertial" in state else {}
        self._last.restore(state.get("heard", ()), last, state["before"])
        self._origin = None if state["origin"] is None else (state["origin"][0], state["origin"][1], state["origin"][2])
        self._lever_arms.body, self._sure, self._ignored = state["body"], bool(state["sure"]), Counter(state["ignored"])

    def summary(self) -> Mapping[str, float | int | str]:
        fused = self._filter
        health = {} if fused is None else fused.health
        ignored = self._ignored + (Counter() if fused is None else fused.ignored)
        return figures(health, self._offsets(), dict(self._unheard()), ignored)

    def _follows(self, name: str, stamp: int) -> bool:
        """Returns whether a message comes after the sensor's last; one that does not is counted."""
        if self._last.follows(name, stamp):
            return True
        self._ignored[f"{name}: stamp not later than the last"] += 1
        return False

    def _offsets(self) -> dict[str, tuple[float, float]]:
        """The time offset of each sensor that has it estimated, in all, and its standard deviation, s."""
        found = {} if self._filter is None else self._filter.offsets()
        return {name: (self._settings(name).offset + at, sigma) for name, (at, sigma) in found.items()}

    def _settings(self, name: str) -> SensorSettings:
        return self.sensors.get(name, _DEFAULT)

    def _config(self) -> FilterConfig:
        inertial = self.motion == "inertial"
        return FilterConfig(
            window=self.window,
            gravity=self.gravity,
            max_gap=self.max_gap,
            inertial=inertial,
            unknown=self._unknown(),
            gates=self._gates,
            errors=errors_of(self.sensors),
            unfelt=self._prior().unfelt(self.gravity) if inertial else None,
        )

    def _unknown(self) -> Noise:
        """The process noise of a motion without inertial sensor."""
        if self.motion == "inertial":
            return Noise(self.free_turning, self.free_acceleration, self.gyro_walk, self.accel_walk)
        return Noise(0.0, self.free_acceleration, self.free_turning, 0.0)

    def _bridge(self, stamp: int) -> bool:
        """Takes the inertial sensor's place where it is silent; False where it is not."""
        assert self._filter is not None
        if not self._dropout.lasts(stamp):
            return False
        self._filter.feel(self._dropout.sample(stamp, self._filter.estimate(stamp)[0]))
        return True

    def _prior(self) -> Prior:
        at_origin = self.start == "origin"
        return prior_of(at_origin, self.heading, self.heading_sigma, self.gyro_bias, self.accel_bias)

    def _feel(self, name: str, imu: Imu, settings: SensorSettings) -> bool:
        """Takes an inertial sample; False where it is ignored."""
        if self.motion == "constant_velocity":
            self._ignored[f"{name}: motion is constant_velocity"] += 1
            return False
        if self._lever_arms.body not in ("", imu.frame):
            raise ValueError(
                f"{name}: a second inertial sensor, {imu.frame!r} beside {self._lever_arms.body!r}: only one can move"
            )
        if settings.offset_sigma:
            raise ValueError(f"{name}: its clock is the one that offsets are related to: it has no offset_sigma")
        try:
            sample = self._inertial.sample(name, imu, imu.stamp - round(settings.offset * 1e9))
        except Unusable as reason:
            self._ignored[f"{name}: {reason}"] += 1
            return False
        self._lever_arms.body = imu.frame
        self._dropout.felt(sample.time)
        if self._filter is not None:
            self._filter.feel(sample)
            for sensor, model, noise in self._constraints.after(sample, self._lever_arms.of(self.base_frame)):
                self._filter.measure(Measurement(sample.time, sensor, model, noise))
            return True
        begun = self._inertial.begun(sample, self._prior(), self.gravity, self._lever_arms.of(self.base_frame))
        if begun is None:
            return False
        self._filter = LateFilter(self._config(), begun[0])
        self._ignored["begun in motion"] += int(not begun[1])
        return True

    def _measure(self, name: str, message: Message, around: Surroundings) -> None:
        if self._filter is None and self.motion == "constant_velocity":
            self._filter = LateFilter(self._config(), coasting_node(message.stamp, self._prior(), self.gravity))
        settings = self._settings(name)
        if never_yields(gate := settings.gate(use_of(name, message, settings))):  # by the setting, or by its type
            self._gates[name] = gate
        before = self._last.before(name, message)
        if self._filter is None:
            self._ignored[f"{name}: before the beginning"] += 1
            return
        if settings.use == "control":
            self._command(name, message, settings, around)
            return
        clock, assumed = self._clock(name)
        if (seen := turning(message, before, around)) is not None:
            self._dropout.saw(message.stamp, seen)
        try:
            for time, sensor, model, noise in measurements(name, message, before, settings, around):
                self._filter.measure(Measurement(time - assumed, sensor, model, noise, clock, assumed * 1e-9))
        except Unusable as reason:
            self._ignored[f"{name}: {reason}"] += 1

    def _clock(self, name: str) -> tuple[int, int]:
        """Returns a sensor's clock in the filter, -1 for none, and the offset (ns) that it is believed to have."""
        assert self._filter is not None
        offsets = self._filter.offsets()
        return (list(offsets).index(name), round(offsets[name][0] * 1e9)) if name in offsets else (-1, 0)

    def _command(self, name: str, message: Message, settings: SensorSettings, around: Surroundings) -> None:
        assert self._filter is not None
        assert isinstance(message, Twist)
        if self.motion == "inertial":
            self._ignored[f"{name}: a control input beside inertial samples"] += 1
        elif not (np.isfinite(message.linear).all() and np.isfinite(message.angular).all()):
            self._ignored[f"{name}: not finite"] += 1
        else:
            turn = around.place(message.frame)[:3, :3]
            time = message.stamp - round(settings.offset * 1e9)
            self._filter.command(Command(time, turn @ message.linear, turn @ message.angular, settings.lag))

    def _odometry(self, stamp: int) -> Odometry | None:
        assert self._filter is not None
        state, rate = self._filter.estimate(stamp)
        self._sure = self._sure or well_known(state.covariance, self.sure)
        if not self._sure:
            return None
        T_body_base = self._lever_arms.of(self.base_frame)
        return odometry_of(state, rate, T_body_base, stamp, self.world_frame, self.base_frame)

    def _status(self, stamp: int) -> Diagnostics | None:
        assert self._filter is not None
        health, ignored = self._filter.health, self._ignored + self._filter.ignored
        others = {}
        if (count := self._filter.hypotheses) > 1:
            others["filter"] = f"{count} headings in question"
        if self._filter.refuted_heading:
            others["heading"] = "the first heading that was told is wrong: measurements contradict it"
        if self._dropout.lasts(stamp):
            others["inertial sensor"] = "silent: the motion is bridged by what others see"
        if (warnings := self._alarms.due(stamp, health, self._filter.ignored, self._gates, others)) is None:
            return None
        warnings |= {f"settings of {name}": f"no stream so far has this name{near}" for name, near in self._unheard()}
        warnings |= unmeasured(self._filter.estimate(stamp)[0].covariance)
        return diagnostics(stamp, health, ignored, self._offsets(), warnings)

    def _unheard(self) -> list[tuple[str, str]]:
        return list(unheard(tuple(self.sensors), sorted(self._last.streams)).items())
