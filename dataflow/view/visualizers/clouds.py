"""Point clouds, clusters, planar lidar and radar."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from dataflow.messages import Clusters, LaserScan, PointCloud, RadarScan
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.scene import TIMELINE

Points = npt.NDArray[np.float64]
Paint = npt.NDArray[np.uint8]

_WAITING = 16
"""Clouds that wait for the pose of their stamp."""

_BITS = 21  # of a coordinate of a cell
_FARTHEST = 1e30  # metres
_KEPT_AT_ONCE = 6_000  # points of one cloud that are looked at for cells: more clouds will come
_SCAN = (255, 90, 90)
_FASTEST = 10.0  # m/s: the end of the scale of radial velocities


@dataclass(slots=True)
class KeptPoints:
    """The cells of a stream of clouds.

    `step`: their side, metres; `after`: clouds with a point in a cell from which it counts.
    """

    step: float
    after: int
    _counts: dict[int, int] = field(default_factory=dict)
    _waiting: deque[tuple[int, str, Points, Paint]] = field(default_factory=lambda: deque(maxlen=_WAITING))

    def add(
        self, stamp: int, frame: str, points: Points, paint: Paint, pose_at: Callable[[str, int], Points | None]
    ) -> Iterator[tuple[int, Points, Paint]]:
        """Takes a cloud in its sensor's frame; gives (stamp, points in the root frame, colours) of cells that are new.

        A cloud waits until the pose of its frame at its stamp is known: it may arrive later.
        """
        self._waiting.append((stamp, frame, points, paint))
        for _ in range(len(self._waiting)):
            entry = self._waiting.popleft()
            T = pose_at(entry[1], entry[0])
            if T is None:
                self._waiting.append(entry)
                continue
            placed = entry[2] @ T[:3, :3].T + T[:3, 3]
            new = self._new(placed)
            if len(new):
                yield entry[0], placed[new], entry[3][new]

    def _new(self, points: Points) -> npt.NDArray[np.int64]:
        """Indices of one point in each cell that has now been seen often enough."""
        cells = np.floor(points / self.step).astype(np.int64)
        limit = 1 << (_BITS - 1)
        inside = np.flatnonzero((np.abs(cells) < limit).all(axis=1))
        x, y, z = (cells[inside] + limit).T
        keys, first = np.unique((x << 2 * _BITS) | (y << _BITS) | z, return_index=True)
        counts, new = self._counts, []
        for key, index in zip(keys.tolist(), first.tolist(), strict=True):
            seen = counts.get(key, 0) + 1
            counts[key] = seen
            if seen == self.after:
                new.append(index)
        return inside[np.array(new, np.int64)]


@visualizer(PointCloud, "space")
def point_cloud(canvas: Canvas, message: PointCloud) -> None:
    """The points in their own colours, else by intensity, else by height (by distance in an optical frame).

    Of a stream that the graph keeps, those that were not seen before, which the view then shows for ever.
    """
    if canvas.stream in canvas.scene.layout.kept:
        _kept(canvas, message)
        return
    kept = thin(canvas, np.flatnonzero(np.isfinite(message.points).all(axis=1)))
    points, paint = message.points[kept], _paint(canvas, message, kept)
    step = np.float32(canvas.scene.options.point_step)
    drawn = np.round(points / step) * step if step else points
    canvas.draw("space", message.frame, rr.Points3D(drawn, colors=paint, radii=rr.Radius.ui_points(1.5)))
    canvas.scene.viewpoint.saw_points(canvas.scene.tree.pose(message.frame), points[::16])


def _paint(canvas: Canvas, message: PointCloud, chosen: npt.NDArray[np.int64]) -> colors.Colors:
    if message.colors is not None:
        return message.colors[chosen]
    values = message.points[chosen, 2] if message.intensities is None else message.intensities[chosen]
    return colors.of_values(values, shades=canvas.scene.options.point_shades)


def _kept(canvas: Canvas, message: PointCloud) -> None:
    """Draws, in the root frame, what fills cells of space that had no point yet."""
    scene, options = canvas.scene, canvas.scene.options
    scene.see(canvas.recording, message.frame, canvas.stamp)
    there = scene.remembered.setdefault((canvas.entity, "kept"), KeptPoints(options.kept_step, options.kept_after))
    chosen = np.flatnonzero(np.isfinite(message.points).all(axis=1))
    chosen = chosen[:: -(-len(chosen) // _KEPT_AT_ONCE) or 1]
    points = message.points[chosen].astype(np.float64)
    scene.viewpoint.saw_points(scene.tree.pose(message.frame), points[::16])
    paint = _paint(canvas, message, chosen)
    root = scene.tree.root or message.frame
    if scene.changed(canvas.entity, "frame of what stays", root):  # asked for from the beginning on
        canvas.log("space/kept", rr.CoordinateFrame(root), static=True)
    for stamp, placed, painted in there.add(canvas.stamp, message.frame, points, paint, scene.tree.pose_at):
        drawn = np.round(placed * 128) / 128  # 8 mm: packs better
        scene.viewpoint.kept_points(placed)
        canvas.recording.set_time(TIMELINE, timestamp=np.datetime64(stamp, "ns"))
        canvas.log("space/kept", rr.Points3D(drawn, colors=painted, radii=rr.Radius.ui_points(1.5)))
    canvas.recording.set_time(TIMELINE, timestamp=np.datetime64(canvas.stamp, "ns"))


@visualizer(Clusters, "space")
def clusters(canvas: Canvas, message: Clusters) -> None:
    """A box around each cluster, or a point at its centroid where it has no bounds."""
    names = range(message.count) if message.ids is None else message.ids.tolist()
    paint = colors.of_identities(list(names))
    drawn: rr.Boxes3D | rr.Points3D
    if message.lower is not None and message.upper is not None:
        shown = finite_rows(message.lower, message.upper)
        drawn = rr.Boxes3D(
            centers=((message.lower + message.upper) / 2)[shown],
            half_sizes=((message.upper - message.lower) / 2)[shown],
            colors=paint[shown],
            labels=[str(names[i]) for i in shown],
            show_labels=True,
        )
    else:
        shown = finite_rows(message.centroids)
        drawn = rr.Points3D(
            message.centroids[shown],
            colors=paint[shown],
            labels=[str(names[i]) for i in shown],
            radii=rr.Radius.ui_points(5.0),
            show_labels=True,
        )
    canvas.draw("space", message.frame, drawn)


@visualizer(LaserScan, "space")
def laser_scan(canvas: Canvas, message: LaserScan) -> None:
    """A point where each beam ended."""
    points = message.points()
    canvas.scene.viewpoint.saw_range(np.linalg.norm(points, axis=1))
    canvas.draw("space", message.frame, rr.Points3D(points, colors=_SCAN, radii=rr.Radius.ui_points(2.5)))


@visualizer(RadarScan, "space")
def radar_scan(canvas: Canvas, message: RadarScan) -> None:
    """Points with arrows along the radial velocity (one second), blue when approaching, red when receding."""
    points = message.points()
    shown = finite_rows(points)
    points = points[shown]
    canvas.scene.viewpoint.saw_range(np.linalg.norm(points, axis=1))
    speeds = None if message.velocities is None else message.velocities[shown].astype(np.float64)
    paint = _SCAN if speeds is None else colors.of_values(speeds, -_FASTEST, _FASTEST)
    canvas.draw("space", message.frame, rr.Points3D(points, colors=paint, radii=rr.Radius.ui_points(4.0)))
    if speeds is not None:
        away = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
        moved = away * np.clip(np.nan_to_num(speeds), -1e3, 1e3)[:, None]
        arrows = rr.Arrows3D(origins=points, vectors=moved, colors=paint, radii=rr.Radius.ui_points(1.0))
        canvas.draw("space/velocity", message.frame, arrows)


def finite_rows(*arrays: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Indices of the rows in which every array is finite, as float32 too, which is what Rerun keeps."""
    good = np.ones(len(arrays[0]), bool)
    for data in arrays:
        good &= (np.abs(data) < _FARTHEST).all(axis=tuple(range(1, data.ndim)))
    return np.flatnonzero(good)


def thin(canvas: Canvas, indices: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Every n-th index, so that at most `max_points` remain; notes it once."""
    most = canvas.scene.options.max_points
    if len(indices) <= most:
        return indices
    canvas.notice(f"shown thinned to at most {most:,} points of a message (option max_points)", "INFO")
    return indices[:: -(-len(indices) // most)]
