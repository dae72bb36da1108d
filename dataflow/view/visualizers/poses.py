"""Visualisers of places: transforms, poses, odometry, paths, particles, satellite fixes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import NavSatFix, Odometry, ParticleSet, Path, Point, Pose, Transforms, Twist
from dataflow.messages.geometry import matrix_to_quaternion, quaternion_from_yaw, quaternion_to_matrix
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.scene import Trail
from dataflow.view.visualizers.clouds import finite_rows, thin

F64 = npt.NDArray[np.float64]

_AXIS = 0.15  # metres
_ARROW = 0.12  # metres: a particle
_NAMES = 0.3  # metres: from a pose to its name, and from there to the next
_GAP = 5.0  # metres: a farther step than this is a jump, and no line is drawn along it


@visualizer(Transforms, "space")
def transforms(canvas: Canvas, message: Transforms) -> None:
    """Frames of the tree, with their axes."""
    canvas.place_frames(message)
    for child in message.child_frames:
        if child and canvas.scene.changed(canvas.entity, f"axes {child}", True):
            where = f"space/{rr.escape_entity_path_part(child)}"
            canvas.log(where, rr.CoordinateFrame(child), _axes(np.eye(4), 0.6 * _AXIS), static=True)


@visualizer(Point, "space")
def point(canvas: Canvas, message: Point) -> None:
    """A dot with the stream's name, and the covariance of its position."""
    if not np.isfinite(message.position).all():
        canvas.clear("space/point")
        canvas.clear("space/covariance")
        return
    name = "/".join(canvas.stream.split("/")[-2:])
    dot = rr.Points3D([message.position], radii=rr.Radius.ui_points(5.0), labels=[name], show_labels=True)
    canvas.draw("space/point", message.frame, dot)
    if message.covariance is not None:
        _ellipsoid(canvas, message.frame, message.position, message.covariance)


@visualizer(Pose, "space")
def pose(canvas: Canvas, message: Pose) -> None:
    """Axes, the trail behind them, the covariance of the position; a named child frame follows the pose."""
    canvas.place_frames(message)
    _moving(canvas, message.frame, message.matrix(), message.covariance)


@visualizer(Odometry, "space", "plot")
def odometry(canvas: Canvas, message: Odometry) -> None:
    """As a pose, and a curve of the speed: as given, else from one pose to the next; and of the rate of turn."""
    canvas.place_frames(message)
    _moving(canvas, message.frame, message.matrix(), message.pose_covariance)
    speed = None if message.linear is None else float(np.linalg.norm(message.linear))
    before = canvas.scene.remembered.get((canvas.entity, "before"))
    canvas.scene.remembered[canvas.entity, "before"] = (message.stamp, message.position)
    if speed is None and before is not None and message.stamp > before[0]:
        speed = float(np.linalg.norm(message.position - before[1])) / ((message.stamp - before[0]) / 1e9)
    if speed is not None:
        canvas.plot("speed", [speed], ["speed m/s"])
    if message.angular is not None:
        canvas.plot("turn", [float(np.linalg.norm(message.angular))], ["turn rad/s"])


@visualizer(Twist, "plot", plots=("linear", "angular"))
def twist(canvas: Canvas, message: Twist) -> None:
    """Curves of the velocities along and about each axis."""
    canvas.plot("linear", message.linear, ["vx m/s", "vy m/s", "vz m/s"])
    canvas.plot("angular", message.angular, ["wx rad/s", "wy rad/s", "wz rad/s"])


@visualizer(Path, "space")
def path(canvas: Canvas, message: Path) -> None:
    """The whole path as a line."""
    shown = finite_rows(message.positions)
    color = canvas.scene.trail_color(canvas.stream, canvas.scene.layout.of_type(Path))
    strips = [message.positions[shown]] if len(shown) > 1 else []
    canvas.draw("space", message.frame, rr.LineStrips3D(strips, colors=color, radii=rr.Radius.ui_points(2.0)))


@visualizer(ParticleSet, "space")
def particle_set(canvas: Canvas, message: ParticleSet) -> None:
    """An arrow along x per particle, coloured by weight."""
    kept = thin(canvas, finite_rows(message.poses))
    poses = message.poses[kept]
    if poses.shape[1] == 3:
        positions = np.column_stack([poses[:, :2], np.zeros(len(poses))])
        rotations = quaternion_from_yaw(poses[:, 2])
    else:
        positions, rotations = poses[:, :3], poses[:, 3:]
    ahead = quaternion_to_matrix(rotations)[..., 0] if len(poses) else np.zeros((0, 3))
    paint = colors.of_values(message.weights[kept])
    arrows = rr.Arrows3D(origins=positions, vectors=ahead * _ARROW, colors=paint, radii=rr.Radius.ui_points(1.0))
    canvas.draw("space", message.frame, arrows)


@visualizer(NavSatFix, "map", "plot")
def nav_sat_fix(canvas: Canvas, message: NavSatFix) -> None:
    """A point on the map, the way so far, and the height as a curve; nothing without a fix."""
    if np.isfinite(message.altitude):
        canvas.plot("altitude", [message.altitude], ["altitude m"])
    if not (np.isfinite(message.latitude) and np.isfinite(message.longitude)):
        canvas.clear("map/fix")
        return
    here = np.array([message.latitude, message.longitude])
    color = canvas.scene.trail_color(canvas.stream, canvas.scene.layout.of_type(NavSatFix))
    canvas.log("map/fix", rr.GeoPoints(lat_lon=[here], radii=rr.Radius.ui_points(7.0), colors=color))
    before = canvas.scene.trails.get(canvas.entity)
    if before is not None:
        canvas.log("map/way", rr.GeoLineStrings(lat_lon=[[before.position, here]], colors=color))
    canvas.scene.trails[canvas.entity] = Trail("", here)


def _moving(canvas: Canvas, frame: str, T_frame_child: F64, covariance: F64 | None) -> None:
    if not np.isfinite(T_frame_child).all():
        for path in ("space/axes", "space/covariance", "space/name"):
            canvas.clear(path)
        canvas.scene.trails.pop(canvas.entity, None)
        canvas.scene.remembered.pop((canvas.entity, "pose"), None)
        return
    if not canvas.scene.due(canvas.entity, canvas.stamp):
        return
    canvas.draw("space/axes", frame, _axes(T_frame_child, _AXIS))
    position = T_frame_child[:3, 3]
    if covariance is not None:
        _ellipsoid(canvas, frame, position, covariance[:3, :3])
    _trail(canvas, frame, position)
    _name(canvas, frame, position)


def _name(canvas: Canvas, frame: str, position: F64) -> None:
    """The stream's name in the colour of its trail, above the pose; names of several streams one above the other."""
    rivals = canvas.scene.layout.of_type(Pose, Odometry)
    height = _NAMES * (1 + rivals.index(canvas.stream)) if canvas.stream in rivals else _NAMES
    name = rr.Points3D(
        [position + np.array([0.0, 0.0, height])],
        colors=canvas.scene.trail_color(canvas.stream, rivals),
        radii=rr.Radius.ui_points(1.0),
        labels=["/".join(canvas.stream.split("/")[-2:])],
        show_labels=True,
    )
    canvas.draw("space/name", frame, name)


def _trail(canvas: Canvas, frame: str, position: F64) -> None:
    """One segment, from the last vertex to here: the view shows all of them, so a trail costs the same for ever."""
    last = canvas.scene.trails.get(canvas.entity)
    if last is None or last.frame != frame:
        canvas.scene.trails[canvas.entity] = Trail(frame, position)
        return
    step = float(np.linalg.norm(position - last.position))
    if step < canvas.scene.options.trail:
        return
    canvas.scene.viewpoint.saw_places(canvas.scene.tree.pose(frame), position)
    if step <= _GAP:
        color = canvas.scene.trail_color(canvas.stream, canvas.scene.layout.of_type(Pose, Odometry))
        segment = rr.LineStrips3D([[last.position, position]], colors=color, radii=rr.Radius.ui_points(2.0))
        canvas.draw("space/trail", frame, segment)
    canvas.scene.trails[canvas.entity] = Trail(frame, position)


def _axes(T: F64, length: float) -> rr.Arrows3D:
    return rr.Arrows3D(
        origins=np.repeat(T[None, :3, 3], 3, axis=0),
        vectors=T[:3, :3].T * length,
        colors=list(colors.AXES),
        radii=rr.Radius.ui_points(2.0),
    )


def _ellipsoid(canvas: Canvas, frame: str, center: F64, covariance: F64) -> None:
    """Two standard deviations of a position. A covariance that is none (not finite, not positive) is not drawn."""
    if not np.isfinite(covariance).all():
        covariance = np.zeros((3, 3))
    variances, directions = np.linalg.eigh((covariance + covariance.T) / 2)
    if variances.min() < -1e-9 or variances.max() <= 0:
        canvas.clear("space/covariance")
        return
    if np.linalg.det(directions) < 0:
        directions[:, 0] *= -1
    ellipsoid = rr.Ellipsoids3D(
        centers=[center],
        half_sizes=[2 * np.sqrt(np.maximum(variances, 0))],
        quaternions=[matrix_to_quaternion(directions)],
        colors=(*colors.NEUTRAL, 120),
    )
    canvas.draw("space/covariance", frame, ellipsoid)
