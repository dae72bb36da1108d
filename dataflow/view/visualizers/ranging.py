"""Planar lidar and radar."""

from __future__ import annotations

import numpy as np
import rerun as rr

from dataflow.messages import LaserScan, RadarScan
from dataflow.view import colors
from dataflow.view.canvas import Canvas, visualizer
from dataflow.view.visualizers.clouds import finite_rows

_SCAN = (255, 90, 90)
_FASTEST = 10.0  # m/s: the end of the scale of radial velocities


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
    if message.velocities is None:
        canvas.draw("space", message.frame, rr.Points3D(points, colors=_SCAN, radii=rr.Radius.ui_points(4.0)))
        return
    speeds = message.velocities[shown].astype(np.float64)
    paint = colors.of_values(speeds, -_FASTEST, _FASTEST)
    canvas.draw("space", message.frame, rr.Points3D(points, colors=paint, radii=rr.Radius.ui_points(4.0)))
    away = points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-9)
    canvas.draw(
        "space/velocity",
        message.frame,
        rr.Arrows3D(
            origins=points,
            vectors=away * np.clip(np.nan_to_num(speeds), -1e3, 1e3)[:, None],
            colors=paint,
            radii=rr.Radius.ui_points(1.0),
        ),
    )
