"""Interprets the messages of a sensor: from types, frames and covariances to measurements of the body."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Imu,
    LandmarkSightings,
    MagneticField,
    Message,
    NavSatFix,
    Odometry,
    Pose,
    RadarScan,
    Twist,
)
from dataflow.messages.geometry import invert, quaternion_to_matrix, transform_matrix
from operators.fusion.filter.measurements import (
    AngularRate,
    FullPose,
    MagneticHeading,
    Model,
    Orientation,
    Position,
    Range,
    Velocity,
)
from operators.fusion.sensors.covariances import UnusableMessage, check_finite, covariance_of, positive, white_part
from operators.fusion.sensors.settings import SensorSettings, use_of
from operators.geometry import se3
from operators.geometry.geodesy import east_north_up

Array = NDArray[np.float64]
Found = tuple[int, str, Model, Array]
_I3 = np.eye(3)


@dataclass
class MeasurementContext:
    """Holds what measurements are related to: places of sensors on the body, the world's frame, origin and landmarks.

    `ignored` counts what is passed over of a message whose rest serves.
    """

    place: Callable[[str], Array]
    world_frame: str
    origin: tuple[float, float, float] | None = None
    landmarks: LandmarkSightings | None = None
    ignored: Counter[str] = field(default_factory=Counter)


def measurements(
    name: str, message: Message, before: Message | None, settings: SensorSettings, around: MeasurementContext
) -> Iterator[Found]:
    """Yields (time, sensor, model, covariance) of a message; `before` is the sensor's last.

    Raises UnusableMessage for a message without use, ValueError for one that its settings do not fit.
    """
    use = use_of(name, message, settings)
    time = message.stamp - round(settings.offset * 1e9)
    if isinstance(message, NavSatFix):
        yield time, name, *_fix(name, message, settings, around)
    elif use in ("position", "pose", "orientation"):
        yield time, name, *_absolute(name, use, message, settings, around)
    elif use == "wheels":
        yield from _wheels(time, name, message, settings, around)
    elif use == "velocity":
        yield from _velocity(time, name, message, before, settings, around)
    elif isinstance(message, MagneticField):
        measured = around.place(message.frame)[:3, :3] @ message.field
        check_finite(measured)
        if not measured.any():
            raise UnusableMessage("no field")
        sigma = settings.angular_sigma or 0.1
        yield time, name, MagneticHeading(measured, settings.azimuth), np.array([[sigma**2]])
    elif isinstance(message, RadarScan) and use == "doppler":
        yield from _doppler(time, name, message, settings, around)
    elif isinstance(message, LandmarkSightings | RadarScan):
        yield from _ranges(time, name, message, settings, around)


def _fix(name: str, fix: NavSatFix, settings: SensorSettings, around: MeasurementContext) -> tuple[Model, Array]:
    if fix.status == "no_fix":
        raise UnusableMessage("no fix")
    check_finite(np.array([fix.latitude, fix.longitude]))
    if around.origin is None:
        around.origin = (fix.latitude, fix.longitude, fix.altitude if math.isfinite(fix.altitude) else 0.0)
    high = math.isfinite(fix.altitude)
    place = east_north_up(fix.latitude, fix.longitude, fix.altitude if high else around.origin[2], around.origin)
    if not high:
        place[2] = np.nan
        around.ignored[f"{name}: altitude, which it does not give"] += 1
    known = np.isfinite(place)
    noise = white_part(covariance_of(name, fix.covariance, settings.sigma, "sigma"), settings.drift)
    return Position(place, around.place(fix.frame)[:3, 3]), noise[np.ix_(known, known)]


def _absolute(
    name: str, use: str, message: Message, settings: SensorSettings, around: MeasurementContext
) -> tuple[Model, Array]:
    if isinstance(message, Imu):
        if message.orientation is None:
            raise UnusableMessage("no orientation")
        check_finite(message.orientation)
        R = quaternion_to_matrix(message.orientation) @ around.place(message.frame)[:3, :3].T
        C = covariance_of(name, message.orientation_covariance, settings.angular_sigma, "angular_sigma")
        return Orientation(R), R.T @ C @ R
    assert isinstance(message, Pose | Odometry)
    if message.frame != around.world_frame:
        raise ValueError(
            f"{name}: poses are in the frame {message.frame!r}, the filter's is {around.world_frame!r}: odometry in "
            "another frame is used as 'velocity'"
        )
    check_finite(message.position, message.orientation)
    given = message.covariance if isinstance(message, Pose) else message.pose_covariance
    T_body_child = around.place(message.child_frame)
    T = transform_matrix(message.position, message.orientation) @ invert(T_body_child)
    R = T[:3, :3]
    C = np.zeros((6, 6))
    if use != "orientation":
        told = None if given is None else given[:3, :3]
        C[:3, :3] = white_part(covariance_of(name, told, settings.sigma, "sigma"), settings.drift)
    if use == "position":
        return Position(message.position, T_body_child[:3, 3]), C[:3, :3]
    angular = covariance_of(name, None if given is None else given[3:, 3:], settings.angular_sigma, "angular_sigma")
    C[3:, 3:] = angular
    if given is not None and settings.sigma is None and settings.angular_sigma is None:
        C[:3, 3:], C[3:, :3] = given[:3, 3:], given[3:, :3]
        positive(C)
    J = np.eye(6)
    J[3:, 3:] = R.T
    if use == "orientation":
        return Orientation(R), R.T @ angular @ R
    J[:3, 3:] = -se3.skew(T[:3, 3] - message.position)
    return FullPose(T[:3, 3], R), J @ C @ J.T


def _twist(message: Message, before: Message | None) -> tuple[int, Array, Array, Array | None]:
    """Half the time since, linear and angular velocity (3,) in the child frame, and their covariance, of a message."""
    if isinstance(message, Twist):
        return 0, message.linear, message.angular, message.covariance
    assert isinstance(message, Odometry)
    if message.linear is not None and message.angular is not None:
        return 0, message.linear, message.angular, message.twist_covariance
    if not isinstance(before, Odometry) or before.frame != message.frame:
        raise UnusableMessage("first of its kind")
    span = message.stamp - before.stamp
    if not np.isfinite(before.position).all() or not np.isfinite(message.position).all():
        raise UnusableMessage("not finite")
    step = se3.log(invert(before.matrix()) @ message.matrix()) / (span * 1e-9)
    return span // 2, step[:3], step[3:], None


def turning(message: Message, before: Message | None, around: MeasurementContext) -> Array | None:
    """Returns how fast the body turns (3,) in its own axes, rad/s, by an odometry or a twist, if they hold it."""
    if not isinstance(message, Odometry | Twist):
        return None
    try:
        _, _, angular, _ = _twist(message, before)
    except UnusableMessage:
        return None
    frame = message.child_frame if isinstance(message, Odometry) else message.frame
    return np.asarray(around.place(frame)[:3, :3] @ angular)


def _velocity(
    time: int, name: str, message: Message, before: Message | None, settings: SensorSettings, around: MeasurementContext
) -> Iterator[Found]:
    half, linear, angular, given = _twist(message, before)
    check_finite(linear, angular)
    frame = message.child_frame if isinstance(message, Odometry) else message.frame  # type: ignore[attr-defined]
    T_body_sensor = around.place(frame)
    axes = T_body_sensor[:3, :3].T
    if _metric(message):
        C = covariance_of(name, None if given is None else given[:3, :3], settings.sigma, "sigma")
        yield time - half, f"{name} linear", Velocity(linear, axes, T_body_sensor[:3, 3]), C
    else:
        around.ignored[f"{name}: scale unknown"] += 1
    C = covariance_of(name, None if given is None else given[3:, 3:], settings.angular_sigma, "angular_sigma")
    yield time - half, f"{name} angular", AngularRate(angular, axes), C


def _metric(message: Message) -> bool:
    """Returns whether lengths are metres: positions of a camera without known scale have infinite variance."""
    given = message.pose_covariance if isinstance(message, Odometry) else None
    return given is None or bool(np.isfinite(np.diag(given)[:3]).any())


def _wheels(
    time: int, name: str, message: Message, settings: SensorSettings, around: MeasurementContext
) -> Iterator[Found]:
    """Forward speed, no slip aside or upwards, and rest when the wheels stand."""
    half, linear, angular, given = _twist(message, None)
    check_finite(linear, angular)
    frame = message.child_frame if isinstance(message, Odometry) else message.frame  # type: ignore[attr-defined]
    T_body_base = around.place(frame)
    axes, lever = T_body_base[:3, :3].T, T_body_base[:3, 3]
    if abs(linear[0]) + abs(angular[2]) * 0.2 <= settings.still:
        yield time, f"{name} standstill", Velocity(np.zeros(3), axes, lever), _I3 * 0.005**2
        yield time, f"{name} no turn", AngularRate(np.zeros(3), axes), _I3 * 0.002**2
        return
    C = np.diag([0.0, 0.02**2, 0.02**2])
    C[0, 0] = covariance_of(name, None if given is None else given[:1, :1], settings.sigma, "sigma")[0, 0]
    yield time - half, name, Velocity(np.array([linear[0], 0.0, 0.0]), axes, lever), C


def _doppler(
    time: int, name: str, scan: RadarScan, settings: SensorSettings, around: MeasurementContext
) -> Iterator[Found]:
    if scan.velocities is None:
        raise UnusableMessage("no Doppler velocities")
    T_body_radar = around.place(scan.frame)
    a = scan.azimuths.astype(np.float64)
    e = np.zeros_like(a) if scan.elevations is None else scan.elevations.astype(np.float64)
    directions = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]) @ T_body_radar[:3, :3].T
    sigma = settings.sigma or 0.1
    for direction, velocity in zip(directions, scan.velocities.tolist(), strict=True):
        if np.isfinite(direction).all() and math.isfinite(velocity):
            model = Velocity(np.array([-velocity]), direction[None], T_body_radar[:3, 3])
            yield time, name, model, np.array([[sigma**2]])
        else:
            around.ignored[f"{name}: detection not finite"] += 1


def _ranges(
    time: int, name: str, sightings: LandmarkSightings | RadarScan, settings: SensorSettings, around: MeasurementContext
) -> Iterator[Found]:
    """Distances to identified landmarks, for a radar by the `ids` of its detections."""
    if sightings.ranges is None:
        raise UnusableMessage("no ranges")
    if sightings.ids is None:
        raise UnusableMessage("no identities")
    covariances = sightings.covariances if isinstance(sightings, LandmarkSightings) else None
    if around.landmarks is None or around.landmarks.positions is None:
        raise UnusableMessage("no map of landmarks")
    if around.landmarks.positions.shape[1] != 3:
        raise ValueError(f"{name}: the map of landmarks is planar, and ranges are measured in space")
    places = dict(zip(around.landmarks.ids.tolist(), around.landmarks.positions, strict=True))
    lever = around.place(sightings.frame)[:3, 3]
    for k, (identity, distance) in enumerate(zip(sightings.ids.tolist(), sightings.ranges.tolist(), strict=True)):
        C = None if covariances is None else covariances[k, :1, :1]
        try:
            noise = covariance_of(name, C, settings.sigma, "sigma")[:1, :1]
            if identity not in places:
                raise UnusableMessage("landmark not in the map")
            check_finite(np.array([distance]), places[identity])
        except UnusableMessage as reason:
            around.ignored[f"{name}: {reason}"] += 1
        else:
            yield time, name, Range(np.array([distance]), places[identity], lever), noise
