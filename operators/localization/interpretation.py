"""Interprets the messages of sensors as observations of the robot's pose in the plane."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Boxes3D,
    LandmarkSightings,
    LaserScan,
    Message,
    NavSatFix,
    Odometry,
    PointCloud,
    Pose,
    Transforms,
)
from dataflow.messages.geometry import transform_points, yaw_of
from operators.geometry.extrinsics import transform_between
from operators.geometry.geodesy import east_north_up
from operators.localization.likelihood_field import LikelihoodField
from operators.localization.observations import Observation, Placed, Scan, Sightings

Array = NDArray[np.float64]


_FARTHEST = 1e6  # metres from the origin of a map: farther landmarks are none


class UnusableMessage(Exception):
    """Raised for a message that is ignored; the text names the reason."""


@dataclass(frozen=True, eq=False)
class LocalizationContext:
    """Holds what messages are related to: the robot, the map and what is known of its landmarks and objects.

    `band`: heights (m) between which points count; `points`: how many; `worth`: how many of them are independent;
    `own`: what is nearer (m) is the robot itself; `object_sigma`: of boxes without covariance, metres.
    """

    base_frame: str
    map_frame: str
    extrinsics: Transforms | None = None
    field: LikelihoodField | None = None
    landmarks: LandmarkSightings | None = None
    objects: Boxes3D | None = None
    origin: tuple[float, float, float] | None = None
    band: tuple[float, float] = (0.1, 1.4)
    points: int = 60
    worth: float = 15.0
    own: float = 0.4
    object_sigma: float = 0.15


MODALITIES: dict[type[Message], str] = {
    PointCloud: "lidar",
    LaserScan: "lidar",
    LandmarkSightings: "landmarks",
    Boxes3D: "landmarks",
    Pose: "positions",
    Odometry: "positions",
    NavSatFix: "positions",
}


def observation(name: str, message: Message, around: LocalizationContext) -> Observation:
    """Returns a message's observation of the pose.

    Raises UnusableMessage for a message without use, ValueError for one that does not belong to this map or robot.
    """
    if isinstance(message, PointCloud | LaserScan):
        return _scan(message, around)
    if isinstance(message, LandmarkSightings):
        return _landmarks(name, message, around)
    if isinstance(message, Boxes3D):
        return _objects(message, around)
    if isinstance(message, NavSatFix):
        return _fix(name, message, around)
    assert isinstance(message, Pose | Odometry)
    return _placed(name, message, around)


def _scan(message: PointCloud | LaserScan, around: LocalizationContext) -> Scan:
    """Points of the band, spread evenly over the directions in which there are any."""
    if around.field is None:
        raise UnusableMessage("no map")
    points = message.points if isinstance(message, PointCloud) else message.points()
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    T = transform_between(around.extrinsics, message.frame, around.base_frame)
    points = transform_points(T, points)
    far = np.hypot(points[:, 0], points[:, 1])
    low, high = around.band
    points = points[(points[:, 2] >= low) & (points[:, 2] <= high) & (far >= around.own)]
    if len(points) < 8:
        raise UnusableMessage("fewer than 8 points in the band")
    ordered = points[np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable"), :2]
    chosen = np.linspace(0, len(ordered) - 1, min(around.points, len(ordered))).astype(int)
    return Scan(around.field, ordered[chosen], around.worth)


def _landmarks(name: str, sightings: LandmarkSightings, around: LocalizationContext) -> Sightings:
    if around.landmarks is None or around.landmarks.positions is None:
        raise UnusableMessage("no map of landmarks")
    _same_frame(name, "the map of landmarks", around.landmarks.frame, around.map_frame)
    if sightings.covariances is None:
        raise ValueError(f"{name}: sightings have no covariances: how well a landmark was seen must be known")
    seen, spread = cartesian(sightings)
    flat, placed = _placed_at(around.landmarks.positions)
    everywhere = flat[placed]
    known = {i: flat[k : k + 1] for k, i in enumerate(around.landmarks.ids.tolist()) if placed[k]}
    places = [known.get(i) if i >= 0 else everywhere for i in sightings.ids.tolist()]
    return _sightings(seen, spread, places, sightings.frame, around)


def _objects(boxes: Boxes3D, around: LocalizationContext) -> Sightings:
    if around.objects is None:
        raise UnusableMessage("no map of objects")
    _same_frame("objects", "their map", around.objects.frame, around.map_frame)
    by_class: dict[str, Array] = {}
    flat, placed = _placed_at(around.objects.centers)
    labels = around.objects.labels()
    for label in set(labels):
        chosen = [k for k, other in enumerate(labels) if other == label and placed[k]]
        by_class[label] = flat[chosen]
    spread = boxes.covariances
    if spread is None:
        spread = np.tile(np.eye(3) * around.object_sigma**2, (boxes.count, 1, 1))
    return _sightings(boxes.centers, spread, [by_class.get(label) for label in boxes.labels()], boxes.frame, around)


def _placed_at(positions: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Positions (N, 2) in the plane of what a map holds, and which of them (N,) are somewhere."""
    flat = np.asarray(positions[:, :2])
    return flat, np.asarray((np.abs(flat) < _FARTHEST).all(axis=1))  # not where a coordinate is not finite


def _sightings(
    seen: Array, spread: Array, places: list[Array | None], frame: str, around: LocalizationContext
) -> Sightings:
    """Sightings in the plane of the robot, of what is usable and in the map."""
    T = transform_between(around.extrinsics, frame, around.base_frame)
    flat = transform_points(T, seen)[:, :2]
    spread = (T[:3, :3] @ spread @ T[:3, :3].T)[:, :2, :2]
    usable = np.asarray(np.isfinite(flat).all(axis=1) & np.isfinite(spread).all(axis=(1, 2)))
    usable &= np.linalg.eigvalsh(np.where(usable[:, None, None], spread, 0.0))[:, 0] > 0
    chosen = [k for k, there in enumerate(places) if there is not None and len(there) and usable[k]]
    if not chosen:
        raise UnusableMessage("nothing of it is in the map")
    return Sightings(flat[chosen], spread[chosen], tuple(places[k] for k in chosen))  # type: ignore[misc]


def cartesian(sightings: LandmarkSightings) -> tuple[Array, Array]:
    """Returns points (N, 3) in the sensor's frame and their covariances (N, 3, 3).

    Planar sightings have the height 0 and a variance of 1 m² along it. Raises ValueError for bearings or ranges alone.
    """
    N = sightings.count
    assert sightings.covariances is not None
    C = np.zeros((N, 3, 3))
    if sightings.positions is not None:
        flat = sightings.positions
        size = flat.shape[1]
        C[:, 2, 2] = 1.0
        C[:, :size, :size] = sightings.covariances[:, :size, :size]
        return np.column_stack([flat, np.zeros((N, 3 - size))]), C
    if sightings.ranges is None or sightings.bearings is None:
        raise ValueError("sightings need positions, or ranges and bearings: one of the two does not say where it is")
    r, b = sightings.ranges, sightings.bearings
    e = np.zeros(N) if sightings.elevations is None else sightings.elevations
    r, b, e = (np.where(np.isfinite(one), one, np.nan) for one in (r, b, e))
    polar = np.zeros((N, 3, 3))
    polar[:, 2, 2] = np.maximum(1e-4, 1.0 / np.maximum(r, 0.1) ** 2) if sightings.elevations is None else 0.0
    size = sightings.covariances.shape[1]
    polar[:, :size, :size] = sightings.covariances
    cb, sb, ce, se = np.cos(b), np.sin(b), np.cos(e), np.sin(e)
    J = np.stack(
        [
            np.stack([ce * cb, -r * ce * sb, -r * se * cb], axis=1),
            np.stack([ce * sb, r * ce * cb, -r * se * sb], axis=1),
            np.stack([se, np.zeros(N), r * ce], axis=1),
        ],
        axis=1,
    )
    return np.column_stack([r * ce * cb, r * ce * sb, r * se]), J @ polar @ J.transpose(0, 2, 1)


def _placed(name: str, message: Pose | Odometry, around: LocalizationContext) -> Placed:
    _same_frame(name, "its frame", message.frame, around.map_frame)
    given = message.covariance if isinstance(message, Pose) else message.pose_covariance
    if given is None:
        raise ValueError(f"{name}: its messages have no covariance: how good the positions are must be known")
    if not (np.isfinite(message.position).all() and np.isfinite(message.orientation).all()):
        raise UnusableMessage("not finite")
    T = transform_between(around.extrinsics, message.child_frame or around.base_frame, around.base_frame)
    heading = None
    if 0.0 < given[5, 5] < 1.0:  # else, NaN too, the heading is unknown
        turn = math.atan2(T[1, 0], T[0, 0])
        heading = (float(yaw_of(message.orientation)) - turn, float(given[5, 5]))
    return _place(message.position[:2], given[:2, :2], T, heading)


def _fix(name: str, fix: NavSatFix, around: LocalizationContext) -> Placed:
    if fix.status == "no_fix" or not (math.isfinite(fix.latitude) and math.isfinite(fix.longitude)):
        raise UnusableMessage("no fix")
    if around.origin is None:
        raise ValueError(f"{name}: satellite fixes need `origin`: latitude, longitude, altitude of the map's origin")
    if fix.covariance is None:
        raise ValueError(f"{name}: its fixes have no covariance: how good they are must be known")
    altitude = fix.altitude if math.isfinite(fix.altitude) else around.origin[2]
    place = east_north_up(fix.latitude, fix.longitude, altitude, around.origin)
    T = transform_between(around.extrinsics, fix.frame, around.base_frame)
    return _place(place[:2], fix.covariance[:2, :2], T, None)


def _place(place: Array, covariance: Array, T: Array, heading: tuple[float, float] | None) -> Placed:
    if not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] <= 0:
        raise UnusableMessage("covariance not positive")
    return Placed(place, covariance, T[:2, 3], heading)


def _same_frame(name: str, what: str, found: str, frame: str) -> None:
    if found != frame:
        raise ValueError(f"{name}: {what} is {found!r}, but the robot is looked for in {frame!r}")
