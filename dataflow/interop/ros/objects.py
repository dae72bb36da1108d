"""Detections and markers of ROS as messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from dataflow.interop.access_tracking import lose
from dataflow.interop.ros.values import orientation, vector
from dataflow.messages import Boxes3D, Detections2D, Path
from dataflow.recording.errors import RecordingError

CUBE, LINE_STRIP, CUBE_LIST = 1, 4, 6
"""Types of visualization_msgs/Marker that have a counterpart."""
DELETE = (2, 3)


def detections_2d(message: Any, stamp: int) -> Detections2D:
    """vision_msgs/Detection2DArray: the best hypothesis of each; turned boxes as the upright ones around them.

    ROS does not say how large the image is: its size is the smallest that holds all boxes.
    """
    boxes, best = [], []
    for detection in message.detections:
        x, y, angle = _center_2d(detection.bbox.center)
        if angle:
            lose(message, "how boxes are turned (the upright ones around them are kept)")
        half_w, half_h = 0.5 * detection.bbox.size_x, 0.5 * detection.bbox.size_y
        cos, sin = abs(math.cos(angle)), abs(math.sin(angle))
        w, h = half_w * cos + half_h * sin, half_w * sin + half_h * cos
        boxes.append((x - w, y - h, x + w, y + h))
        best.append(_best(detection))
    corners = np.array(boxes, np.float32).reshape(-1, 4)
    names, classes = _classes([name for name, _ in best])
    return Detections2D(
        stamp=stamp,
        frame=message.header.frame_id,
        width=max(1, math.ceil(corners[:, 2].max(initial=1.0))),
        height=max(1, math.ceil(corners[:, 3].max(initial=1.0))),
        class_names=names,
        boxes=corners,
        scores=_scores(best),
        class_ids=classes,
        ids=_ids(message.detections),
    )


def detections_3d(message: Any, stamp: int) -> Boxes3D:
    """vision_msgs/Detection3DArray: the best hypothesis of each."""
    best = [_best(detection) for detection in message.detections]
    names, classes = _classes([name for name, _ in best])
    centers = [d.bbox.center for d in message.detections]
    return Boxes3D(
        stamp=stamp,
        frame=message.header.frame_id,
        class_names=names,
        centers=np.array([vector(c.position) for c in centers]).reshape(-1, 3),
        sizes=np.array([vector(d.bbox.size) for d in message.detections]).reshape(-1, 3),
        orientations=np.array([orientation(c.orientation) for c in centers]).reshape(-1, 4),
        scores=_scores(best),
        class_ids=classes,
        ids=_ids(message.detections),
    )


def marker(message: Any, stamp: int) -> Boxes3D | Path:
    """visualization_msgs/Marker: a cube or cubes as boxes, a line strip as a path; others raise `RecordingError`."""
    if message.action in DELETE:
        raise RecordingError("a marker that deletes others has no counterpart")
    if message.type == LINE_STRIP:
        return Path(
            stamp=stamp,
            frame=message.header.frame_id,
            positions=_placed(message, np.array([vector(p) for p in message.points]).reshape(-1, 3)),
        )
    return _boxes([message], stamp)


def marker_array(message: Any, stamp: int) -> Boxes3D:
    """visualization_msgs/MarkerArray: its cubes as boxes whose class is their namespace; other shapes are left out."""
    if others := sorted({m.type for m in message.markers if m.type not in (CUBE, CUBE_LIST)}):
        lose(message, f"markers of the types {', '.join(map(str, others))}")
    return _boxes([m for m in message.markers if m.type in (CUBE, CUBE_LIST) and m.action not in DELETE], stamp)


def _boxes(markers: Sequence[Any], stamp: int) -> Boxes3D:
    frames = {m.header.frame_id for m in markers}
    if len(frames) > 1:
        raise RecordingError(f"markers of several frames do not make one set of boxes: {', '.join(sorted(frames))}")
    centers, sizes, turns, names = [], [], [], []
    for m in markers:
        if m.type not in (CUBE, CUBE_LIST):
            raise RecordingError(f"a marker of type {m.type} has no counterpart; cubes (1, 6) and line strips (4) have")
        offsets = np.zeros((1, 3)) if m.type == CUBE else np.array([vector(p) for p in m.points]).reshape(-1, 3)
        for center in _placed(m, offsets):
            centers.append(center)
            sizes.append(np.abs(vector(m.scale)))
            turns.append(orientation(m.pose.orientation))
            names.append(m.ns)
    table, classes = _classes(names)
    return Boxes3D(
        stamp=stamp,
        frame=frames.pop() if frames else "",
        class_names=table,
        centers=np.array(centers).reshape(-1, 3),
        sizes=np.array(sizes).reshape(-1, 3),
        orientations=np.array(turns).reshape(-1, 4),
        scores=np.ones(len(centers), np.float32),
        class_ids=classes,
    )


def _placed(marker: Any, points: Any) -> Any:
    """Points of a marker in its frame."""
    x, y, z, w = orientation(marker.pose.orientation)
    axis = np.array([x, y, z])
    turned = points + 2 * np.cross(axis, np.cross(axis, points) + w * points)
    return turned + vector(marker.pose.position)


def _center_2d(center: Any) -> tuple[float, float, float]:
    """(x, y, angle) of a Pose2D, which vision_msgs and geometry_msgs declare differently."""
    place = getattr(center, "position", center)
    return float(place.x), float(place.y), float(center.theta)


def _best(detection: Any) -> tuple[str, float]:
    """(class, score) of the likeliest hypothesis; ("", 1) where there is none."""
    found = [getattr(result, "hypothesis", result) for result in detection.results]
    if not found:
        return "", 1.0
    best = max(found, key=lambda h: h.score)
    return str(best.class_id if hasattr(best, "class_id") else best.id), float(best.score)


def _scores(best: Sequence[tuple[str, float]]) -> Any:
    return np.clip(np.array([score for _, score in best], np.float32), 0.0, 1.0)


def _classes(names: Sequence[str]) -> tuple[tuple[str, ...], Any]:
    """A table of class names in alphabetical order, and the index of each object in it."""
    table = tuple(sorted(set(names)))
    return table, np.array([table.index(name) for name in names], np.int32)


def _ids(detections: Sequence[Any]) -> Any:
    """The identities of objects, where all have one that is a number."""
    texts = [str(getattr(d, "id", "") or getattr(d, "tracking_id", "")) for d in detections]
    return np.array([int(t) for t in texts], np.int64) if texts and all(t.isdecimal() for t in texts) else None
