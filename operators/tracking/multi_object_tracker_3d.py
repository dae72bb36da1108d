"""Tracking of objects in space as an operator."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dataflow.messages import Boxes3D, Diagnostics, Odometry, Pose, Tracks, TrackState, Transforms
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import (
    matrix_to_quaternion,
    quaternion_from_yaw,
    quaternion_to_matrix,
    transform_points,
    yaw_of,
)
from dataflow.operator import Counts, In, Operator, Out, Param, Sampled
from operators.geometry.extrinsics import transform_between
from operators.status import counted_status
from operators.tracking.assignment import class_ids_of
from operators.tracking.box_tracker_3d import BoxTracker3D, BoxTracker3DSettings, Solids, SolidTrack


@dataclass(kw_only=True)
class State(Counts):
    """Holds the tracks, what they are of, and the names of their classes in the order of their arrival."""

    tracker: BoxTracker3D
    frame: str | None = None
    classes: list[str] = field(default_factory=list)


class MultiObjectTracker3D(Operator):
    """Follows objects in space: centre and velocity by a Kalman filter, extent and heading by weighted means.

    Boxes are taken to stand upright in the frame in which they are followed: that of `pose`, or their own without one.
    Tracks are tentative, confirmed, coasting or ended, and scored, as by `MultiObjectTracker`.

    Method: Weng et al., "3D multi-object tracking: a baseline and new evaluation metrics", 2020.
    """

    boxes: In[Boxes3D] = In(doc="objects in space, weak ones included")
    pose: Sampled[Pose | Odometry] = Sampled(
        required=False, doc="the sensor or its robot in the frame in which to follow; none follows in the boxes' own"
    )
    extrinsics: Sampled[Transforms] = Sampled(
        required=False, doc="holds the transform between the boxes' frame and that of the pose, where they differ"
    )
    tracks: Out[Tracks] = Out(doc="tentative, confirmed, coasting and just ended tracks, by rising id")
    status: Out[Diagnostics] = Out(doc="tracks by state; a warning where boxes are unusable")

    position_noise: float = Param(0.08, gt=0, doc="standard deviation of a strong box's centre", unit="m")
    acceleration: float = Param(1.5, gt=0, doc="standard deviation of an object's acceleration", unit="m/s²")
    reach: float = Param(1.0, gt=0, doc="farthest from its prediction that an object is sought", unit="m")
    strong: float = Param(0.5, ge=0, le=1, doc="weaker boxes continue confirmed tracks and do nothing else")
    birth: float = Param(0.5, ge=0, le=1, doc="least score of a box that begins a track")
    confirm: float = Param(0.8, ge=0, doc="evidence that confirms a track, the sum of its boxes' log odds")
    memory: float = Param(2.0, gt=0, doc="a track ends that was not matched for so long", unit="s")
    state: State

    def initial_state(self) -> State:
        tracker = BoxTracker3D(
            BoxTracker3DSettings(
                position=self.position_noise,
                acceleration=self.acceleration,
                reach=self.reach,
                strong=self.strong,
                birth=self.birth,
                confirm=self.confirm,
                memory=self.memory,
            )
        )
        return State(tracker=tracker)

    def process(
        self, boxes: Boxes3D, pose: Pose | Odometry | None = None, extrinsics: Transforms | None = None
    ) -> dict[str, Any]:
        """Raises ValueError where no transform relates the frames, or the frame changes."""
        T, frame = np.eye(4), boxes.frame
        if pose is not None and boxes.frame != pose.frame:
            T = pose.matrix() @ transform_between(extrinsics, boxes.frame, pose.child_frame)
            frame = pose.frame
        if self.state.frame is not None and frame != self.state.frame:
            raise ValueError(f"boxes are in {frame}, those before were in {self.state.frame}: give a pose of one frame")
        self.state.frame = frame
        found, unusable = self._solids(boxes, T)
        tracks = self.state.tracker.update(boxes.stamp, found)
        states = Counter(t.state.name.lower() for t in tracks)
        counts = {s.name.lower(): states[s.name.lower()] for s in TrackState} | {"unusable boxes": unusable}
        self.state.counts.update(
            {"messages": 1, "boxes": boxes.count, "unusable boxes": unusable, "tracks ended": states["ended"]}
        )
        text = ", ".join(f"{n} {name}" for name, n in counts.items())
        level = Level.WARN if unusable else Level.OK
        return {
            "tracks": self._message(boxes.stamp, frame, tracks),
            "status": counted_status("multi_object_tracker_3d", boxes.stamp, text, level, counts),
        }

    def on_reset(self, input: str) -> None:
        """Drops all tracks: the clock of an input was reset."""
        self.state.tracker.forget()

    def _solids(self, boxes: Boxes3D, T: Any) -> tuple[Solids, int]:
        """Returns the usable boxes in the tracking frame, and how many are not."""
        usable = np.isfinite(boxes.centers).all(axis=1) & np.isfinite(boxes.sizes).all(axis=1)
        usable &= (boxes.sizes > 0).all(axis=1) & np.isfinite(boxes.orientations).all(axis=1)
        rows = np.flatnonzero(usable)
        rotations = T[:3, :3] @ quaternion_to_matrix(boxes.orientations[rows])
        upright = np.abs(rotations[:, 2, :])  # how far each own axis points up
        sizes = boxes.sizes[rows].copy()
        flipped = np.argmax(upright, axis=1) != 2  # a box that lies on its side, as in an optical frame
        sizes[flipped] = (np.abs(rotations[flipped]) @ sizes[flipped][:, :, None])[:, :, 0]
        yaws = np.where(flipped, 0.0, yaw_of(matrix_to_quaternion(rotations)))
        covariances = None if boxes.covariances is None else T[:3, :3] @ boxes.covariances[rows] @ T[:3, :3].T
        found = Solids(
            transform_points(T, boxes.centers[rows]),
            sizes,
            yaws,
            boxes.scores[rows].astype(np.float64),
            class_ids_of(boxes, self.state.classes)[rows],
            covariances,
        )
        return found, boxes.count - len(rows)

    def _message(self, now: int, frame: str, tracks: list[SolidTrack]) -> Tracks:
        means = np.array([t.mean for t in tracks]).reshape(-1, 6)
        return Tracks(
            stamp=now,
            frame=frame,
            class_names=tuple(self.state.classes),
            ids=np.array([t.id for t in tracks], np.int64),
            states=np.array([t.state for t in tracks], np.uint8),
            scores=np.array([t.score for t in tracks], np.float32),
            class_ids=np.array([t.class_id for t in tracks], np.int32),
            ages=np.array([(now - t.born) * 1e-9 for t in tracks], np.float32),
            unseen=np.array([(now - t.seen) * 1e-9 for t in tracks], np.float32),
            positions=means[:, :3],
            sizes=np.array([t.size for t in tracks]).reshape(-1, 3),
            orientations=quaternion_from_yaw(np.array([t.yaw for t in tracks])).reshape(-1, 4),
            velocities=means[:, 3:],
            covariances=np.array([t.covariance for t in tracks]).reshape(-1, 6, 6),
        )
