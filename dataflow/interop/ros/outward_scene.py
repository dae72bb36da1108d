"""Poses, maps, objects and what is said, as ROS 2 messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dataflow.interop.ros.made import (
    Made,
    header_of,
    make,
    moving,
    placed_at,
    point,
    quaternion,
    time,
    vector,
    with_covariance,
)
from dataflow.messages import (
    Alarm,
    Boxes3D,
    Detections2D,
    Diagnostics,
    Number,
    OccupancyGrid,
    Odometry,
    ParticleSet,
    Path,
    Point,
    Pose,
    Switch,
    Text,
    Transforms,
    Twist,
)

_LOG = {"debug": 10, "info": 20, "warning": 30, "error": 40, "fatal": 50}


def odometry(m: Odometry) -> Made:
    return "nav_msgs/msg/Odometry", make(
        "nav_msgs/Odometry",
        header=header_of(m.stamp, m.frame),
        child_frame_id=m.child_frame,
        pose=with_covariance(m.position, m.orientation, m.pose_covariance),
        twist=moving(m.linear, m.angular, m.twist_covariance),
    )


def point_stamped(m: Point) -> Made:
    return "geometry_msgs/msg/PointStamped", make(
        "geometry_msgs/PointStamped", header=header_of(m.stamp, m.frame), point=point(m.position)
    )


def pose(m: Pose) -> Made:
    placed = with_covariance(m.position, m.orientation, m.covariance)
    return "geometry_msgs/msg/PoseWithCovarianceStamped", make(
        "geometry_msgs/PoseWithCovarianceStamped", header=header_of(m.stamp, m.frame), pose=placed
    )


def twist(m: Twist) -> Made:
    return "geometry_msgs/msg/TwistWithCovarianceStamped", make(
        "geometry_msgs/TwistWithCovarianceStamped",
        header=header_of(m.stamp, m.frame),
        twist=moving(m.linear, m.angular, m.covariance),
    )


def path(m: Path) -> Made:
    turns = [None] * m.count if m.orientations is None else m.orientations
    stamps: Sequence[int] = [0] * m.count if m.stamps is None else m.stamps.tolist()
    poses = [
        make("geometry_msgs/PoseStamped", header=header_of(stamp, m.frame), pose=placed_at(position, turn))
        for stamp, position, turn in zip(stamps, m.positions, turns, strict=True)
    ]
    return "nav_msgs/msg/Path", make("nav_msgs/Path", header=header_of(m.stamp, m.frame), poses=poses)


def occupancy_grid(m: OccupancyGrid) -> Made:
    height, width = m.cells.shape
    info = make(
        "nav_msgs/MapMetaData",
        map_load_time=time(m.stamp),
        resolution=m.resolution,
        width=width,
        height=height,
        origin=placed_at(m.position, m.orientation),
    )
    return "nav_msgs/msg/OccupancyGrid", make(
        "nav_msgs/OccupancyGrid", header=header_of(m.stamp, m.frame), info=info, data=np.array(m.cells).ravel()
    )


def particles(m: ParticleSet) -> Made:
    if m.poses.shape[1] == 3:
        half = 0.5 * m.poses[:, 2]
        rows = [
            placed_at((x, y, 0.0), (0.0, 0.0, s, c))
            for (x, y, _), s, c in zip(m.poses, np.sin(half), np.cos(half), strict=True)
        ]
    else:
        rows = [placed_at(row[:3], row[3:]) for row in m.poses]
    made = make("geometry_msgs/PoseArray", header=header_of(m.stamp, m.frame), poses=rows)
    return "geometry_msgs/msg/PoseArray", made


def transforms(m: Transforms) -> Made:
    rows = []
    for i, child in enumerate(m.child_frames):
        placed = make(
            "geometry_msgs/Transform", translation=vector(m.translations[i]), rotation=quaternion(m.rotations[i])
        )
        header = header_of(m.stamp, m.frames[i])
        rows.append(make("geometry_msgs/TransformStamped", header=header, child_frame_id=child, transform=placed))
    return "tf2_msgs/msg/TFMessage", make("tf2_msgs/TFMessage", transforms=rows)


def _hypotheses(label: str, score: float) -> list[Any]:
    hypothesis = make("vision_msgs/ObjectHypothesis", class_id=label, score=float(score))
    nowhere = with_covariance(np.zeros(3), None, None)
    return [make("vision_msgs/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=nowhere)]


def detections(m: Detections2D) -> Made:
    header = header_of(m.stamp, m.frame)
    rows = []
    for i, (label, (x1, y1, x2, y2)) in enumerate(zip(m.labels(), m.boxes.tolist(), strict=True)):
        middle = make("vision_msgs/Point2D", x=(x1 + x2) / 2, y=(y1 + y2) / 2)
        center = make("vision_msgs/Pose2D", position=middle, theta=0.0)
        box = make("vision_msgs/BoundingBox2D", center=center, size_x=x2 - x1, size_y=y2 - y1)
        identity = "" if m.ids is None else str(m.ids[i])
        results = _hypotheses(label, m.scores[i])
        rows.append(make("vision_msgs/Detection2D", header=header, results=results, bbox=box, id=identity))
    return "vision_msgs/msg/Detection2DArray", make("vision_msgs/Detection2DArray", header=header, detections=rows)


def boxes(m: Boxes3D) -> Made:
    header = header_of(m.stamp, m.frame)
    rows = []
    for i, label in enumerate(m.labels()):
        center = placed_at(m.centers[i], m.orientations[i])
        box = make("vision_msgs/BoundingBox3D", center=center, size=vector(m.sizes[i]))
        identity = "" if m.ids is None else str(m.ids[i])
        results = _hypotheses(label, m.scores[i])
        rows.append(make("vision_msgs/Detection3D", header=header, results=results, bbox=box, id=identity))
    return "vision_msgs/msg/Detection3DArray", make("vision_msgs/Detection3DArray", header=header, detections=rows)


def diagnostics(m: Diagnostics) -> Made:
    owners = [] if m.owners is None else m.owners.tolist()
    rows = []
    for i, name in enumerate(m.names):
        pairs = [
            make("diagnostic_msgs/KeyValue", key=k, value=v)
            for k, v, owner in zip(m.keys, m.values, owners, strict=True)
            if owner == i
        ]
        rows.append(
            make(
                "diagnostic_msgs/DiagnosticStatus",
                level=int(m.levels[i]),
                name=name,
                message=m.messages[i],
                hardware_id=m.hardware_ids[i] if m.hardware_ids else "",
                values=pairs,
            )
        )
    made = make("diagnostic_msgs/DiagnosticArray", header=header_of(m.stamp, ""), status=rows)
    return "diagnostic_msgs/msg/DiagnosticArray", made


def alarm(m: Alarm) -> Made:
    made = make(
        "rcl_interfaces/Log",
        stamp=time(m.stamp),
        level=_LOG[m.level],
        name=m.name,
        msg=m.text,
        file="",
        function="",
        line=0,
    )
    return "rcl_interfaces/msg/Log", made


def number(m: Number) -> Made:
    return "std_msgs/msg/Float64", make("std_msgs/Float64", data=m.value)


def text(m: Text) -> Made:
    return "std_msgs/msg/String", make("std_msgs/String", data=m.text)


def switch(m: Switch) -> Made:
    return "std_msgs/msg/Bool", make("std_msgs/Bool", data=m.on)
