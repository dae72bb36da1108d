"""Poses, motions, paths and transforms of ROS as messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from dataflow.interop.access_tracking import lose
from dataflow.interop.ros.values import covariance, orientation, time_ns, vector
from dataflow.messages import Odometry, ParticleSet, Path, Point, Pose, Transforms, Twist


def odometry(message: Any, stamp: int) -> Odometry:
    """nav_msgs/Odometry."""
    pose, twist = message.pose, message.twist
    return Odometry(
        stamp=stamp,
        frame=_bare(message.header.frame_id),
        child_frame=_bare(message.child_frame_id),
        position=vector(pose.pose.position),
        orientation=orientation(pose.pose.orientation),
        pose_covariance=covariance(pose, "covariance", 6),
        linear=vector(twist.twist.linear),
        angular=vector(twist.twist.angular),
        twist_covariance=covariance(twist, "covariance", 6),
    )


def point(message: Any, stamp: int) -> Point:
    """geometry_msgs/Point and PointStamped."""
    return Point(stamp=stamp, frame=_frame(message), position=vector(getattr(message, "point", message)))


def pose(message: Any, stamp: int) -> Pose:
    """geometry_msgs/Pose, PoseStamped, PoseWithCovariance and PoseWithCovarianceStamped."""
    placed, owner = message, message if hasattr(message, "covariance") else None
    while hasattr(placed, "pose"):
        placed = placed.pose
        owner = placed if hasattr(placed, "covariance") else owner
    return Pose(
        stamp=stamp,
        frame=_frame(message),
        position=vector(placed.position),
        orientation=orientation(placed.orientation),
        covariance=None if owner is None else covariance(owner, "covariance", 6),
    )


def twist(message: Any, stamp: int) -> Twist:
    """geometry_msgs/Twist, TwistStamped and TwistWithCovarianceStamped."""
    moved, owner = message, message if hasattr(message, "covariance") else None
    while hasattr(moved, "twist"):
        moved = moved.twist
        owner = moved if hasattr(moved, "covariance") else owner
    return Twist(
        stamp=stamp,
        frame=_frame(message),
        linear=vector(moved.linear),
        angular=vector(moved.angular),
        covariance=None if owner is None else covariance(owner, "covariance", 6),
    )


def path(message: Any, stamp: int) -> Path:
    """nav_msgs/Path; timed where the stamps of its poses strictly increase."""
    stamps = np.array([time_ns(p.header.stamp) for p in message.poses], np.int64)
    timed = len(stamps) > 0 and stamps[0] > 0 and bool((np.diff(stamps) > 0).all())
    if not timed and len(set(stamps.tolist())) > 1:
        lose(message, "the times of its poses, which do not increase")
    return Path(
        stamp=stamp,
        frame=_frame(message),
        positions=np.array([vector(p.pose.position) for p in message.poses]).reshape(-1, 3),
        orientations=np.array([orientation(p.pose.orientation) for p in message.poses]).reshape(-1, 4),
        stamps=stamps if timed else None,
    )


def pose_array(message: Any, stamp: int) -> ParticleSet:
    """geometry_msgs/PoseArray: poses of equal weight."""
    rows = [np.concatenate([vector(p.position), orientation(p.orientation)]) for p in message.poses]
    return ParticleSet(
        stamp=stamp,
        frame=_frame(message),
        poses=np.array(rows).reshape(-1, 7),
        weights=np.full(len(rows), 1.0 / len(rows)) if rows else np.empty(0),
    )


def transform(message: Any, stamp: int) -> Transforms:
    """geometry_msgs/TransformStamped: a set of one."""
    return transforms([message], stamp)


def transforms(rows: Sequence[Any], stamp: int) -> Transforms:
    """Some geometry_msgs/TransformStamped as one set; of those that place one frame the last counts.

    Frames that begin with a slash, as in early ROS, are named without it. Left out, and lost: a transform of a frame to
    itself, one without a frame, and one that is not finite.
    """
    placed = []
    for row in rows:
        child, parent = _bare(row.child_frame_id), _bare(row.header.frame_id)
        numbers = (vector(row.transform.translation), orientation(row.transform.rotation))
        if child == parent:
            lose(row, f"a transform of {child} to itself")
        elif not child or not parent:
            lose(row, f"a transform from {parent or 'no frame'} to {child or 'no frame'}")
        elif not all(np.isfinite(values).all() for values in numbers):
            lose(row, f"a transform to {child} that is not finite")
        else:
            placed.append(row)
    kept = list({_bare(row.child_frame_id): row for row in placed}.items())
    return Transforms(
        stamp=stamp,
        frames=tuple(_bare(row.header.frame_id) for _, row in kept),
        child_frames=tuple(child for child, _ in kept),
        translations=np.array([vector(row.transform.translation) for _, row in kept]).reshape(-1, 3),
        rotations=np.array([orientation(row.transform.rotation) for _, row in kept]).reshape(-1, 4),
    )


def _frame(message: Any) -> str:
    return _bare(message.header.frame_id) if hasattr(message, "header") else ""


def _bare(frame: str) -> str:
    return frame.removeprefix("/")
