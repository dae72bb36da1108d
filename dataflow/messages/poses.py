"""Places and motions: poses, transforms, odometry, velocities, paths, satellite fixes, particles."""

from __future__ import annotations

from typing import Self

import numpy as np
import numpy.typing as npt

from dataflow.messages.arrays import F64, I64
from dataflow.messages.base import ANCHOR, Message, MessageError, array, scalar
from dataflow.messages.checks import finite, parallel, unique, unit_quaternions, unit_vectors, within
from dataflow.messages.fields.declared import MISSING
from dataflow.messages.geometry import split_matrix, transform_matrix

COVARIANCE_TYPES = ("unknown", "approximated", "diagonal_known", "known")
FIX_STATUSES = ("no_fix", "fix", "sbas", "gbas", "rtk_float", "rtk_fixed")


class Pose(Message):
    """The pose of one frame in another: maps coordinates of `child_frame` to coordinates of `frame`."""

    frame: str = scalar("str", "frame in which the pose is expressed")
    child_frame: str = scalar("str", "frame that is posed; empty where it has no name", default="")
    position: F64 = array("float64", "3", "origin of the child frame in `frame`", unit="m")
    orientation: F64 = array("float64", "4", "unit quaternion (x, y, z, w) that maps the child frame to `frame`")
    covariance: F64 | None = array(
        "float64", "6 6", "of (x, y, z, rotation about the fixed x, y, z axes), in `frame`", unit="m, rad", default=None
    )

    def validate(self) -> None:
        unit_quaternions(self, "orientation")

    @classmethod
    def from_matrix(
        cls,
        matrix: npt.ArrayLike,
        *,
        stamp: int = MISSING,
        frame: str,
        child_frame: str = "",
        covariance: npt.ArrayLike | None = None,
    ) -> Self:
        """The pose of a rigid transform (4, 4)."""
        position, orientation = split_matrix(matrix)
        return cls(
            stamp=stamp,
            frame=frame,
            child_frame=child_frame,
            position=position,
            orientation=orientation,
            covariance=_optional(covariance),
        )

    def matrix(self) -> F64:
        """`T_frame_child` (4, 4)."""
        return transform_matrix(self.position, self.orientation)


class Point(Message):
    """One place: an obstacle, a clicked point, a corner that was found."""

    frame: str = scalar("str", "frame in which the position is expressed", default=ANCHOR)
    position: F64 = array("float64", "3", "the place in `frame`", unit="m")
    covariance: F64 | None = array("float64", "3 3", "of the position, in `frame`", unit="m²", default=None)


class Transforms(Message):
    """A set of transforms between named frames at one time; a single transform is a set of one.

    Fixed transforms (extrinsics) belong on a static stream, moving ones on an ordinary one.
    Transform i maps coordinates of `child_frames[i]` to coordinates of `frames[i]` (parent).
    """

    frames: tuple[str, ...] = scalar("strs", "parent frame of each transform")
    child_frames: tuple[str, ...] = scalar("strs", "child frame of each transform; no child occurs twice")
    translations: F64 = array("float64", "N 3", "origin of each child frame in its parent", unit="m")
    rotations: F64 = array("float64", "N 4", "unit quaternion (x, y, z, w) that maps each child frame to its parent")

    def validate(self) -> None:
        count = len(self.translations)
        parallel(self, "frames", count, "translations")
        parallel(self, "child_frames", count, "translations")
        unit_quaternions(self, "rotations")
        unique(self, "child_frames")
        for frame, child in zip(self.frames, self.child_frames, strict=True):
            if frame == child:
                raise MessageError(f"Transforms.child_frames: {child!r} must differ from its parent frame")

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike, *, stamp: int = MISSING, frame: str, child_frame: str) -> Self:
        """One transform, from a rigid transform `T_frame_child` (4, 4)."""
        translation, rotation = split_matrix(matrix)
        return cls(
            stamp=stamp,
            frames=(frame,),
            child_frames=(child_frame,),
            translations=translation[None],
            rotations=rotation[None],
        )

    @classmethod
    def level_camera(
        cls,
        height: float,
        pitch: float = 0.0,
        *,
        stamp: int = MISSING,
        frame: str = "base_link",
        child_frame: str = "camera",
    ) -> Self:
        """One transform: that of a camera, `height` metres above a level base's ground and not rolled.

        `pitch`, in radians, is how far it looks down; one that looks up has a negative one. `child_frame` is its
        optical frame.
        """
        c, s = np.cos(pitch), np.sin(pitch)
        matrix = np.array([[0, -s, c, 0], [-1, 0, 0, 0], [0, -c, -s, height], [0, 0, 0, 1]])
        return cls.from_matrix(matrix, stamp=stamp, frame=frame, child_frame=child_frame)

    @property
    def count(self) -> int:
        """Number of transforms."""
        return len(self.translations)

    def matrices(self) -> F64:
        """`T_frame_child` (N, 4, 4) of every transform."""
        return transform_matrix(self.translations, self.rotations)

    def matrix(self, child_frame: str) -> F64:
        """`T_frame_child` (4, 4) of one child frame; raises `MessageError` where it is not in the set."""
        if child_frame not in self.child_frames:
            raise MessageError(f"Transforms has no child frame {child_frame!r}; it has {', '.join(self.child_frames)}")
        i = self.child_frames.index(child_frame)
        return transform_matrix(self.translations[i], self.rotations[i])


class Odometry(Message):
    """Pose of the robot in a smooth, possibly drifting frame, with its velocity."""

    frame: str = scalar("str", "frame of the pose, usually `odom`")
    child_frame: str = scalar("str", "frame of the robot, in which the velocities are expressed")
    position: F64 = array("float64", "3", "origin of the child frame in `frame`", unit="m")
    orientation: F64 = array("float64", "4", "unit quaternion (x, y, z, w) that maps the child frame to `frame`")
    pose_covariance: F64 | None = array(
        "float64", "6 6", "of (x, y, z, rotation about the fixed x, y, z axes), in `frame`", unit="m, rad", default=None
    )
    linear: F64 | None = array(
        "float64", "3", "velocity of the child frame's origin, in `child_frame`", unit="m/s", default=None
    )
    angular: F64 | None = array("float64", "3", "angular velocity, in `child_frame`", unit="rad/s", default=None)
    twist_covariance: F64 | None = array(
        "float64", "6 6", "of (linear, angular), in `child_frame`", unit="m/s, rad/s", default=None
    )

    def validate(self) -> None:
        unit_quaternions(self, "orientation")

    @classmethod
    def from_matrix(
        cls,
        matrix: npt.ArrayLike,
        *,
        stamp: int = MISSING,
        frame: str,
        child_frame: str,
        linear: npt.ArrayLike | None = None,
        angular: npt.ArrayLike | None = None,
        pose_covariance: npt.ArrayLike | None = None,
        twist_covariance: npt.ArrayLike | None = None,
    ) -> Self:
        """Odometry from a rigid transform `T_frame_child` (4, 4)."""
        position, orientation = split_matrix(matrix)
        return cls(
            stamp=stamp,
            frame=frame,
            child_frame=child_frame,
            position=position,
            orientation=orientation,
            pose_covariance=_optional(pose_covariance),
            linear=_optional(linear),
            angular=_optional(angular),
            twist_covariance=_optional(twist_covariance),
        )

    def matrix(self) -> F64:
        """`T_frame_child` (4, 4)."""
        return transform_matrix(self.position, self.orientation)


class Twist(Message):
    """A velocity, measured or commanded."""

    frame: str = scalar("str", "frame that moves, and in which its velocity is expressed")
    linear: F64 = array("float64", "3", "linear velocity", unit="m/s")
    angular: F64 = array("float64", "3", "angular velocity", unit="rad/s")
    covariance: F64 | None = array("float64", "6 6", "of (linear, angular)", unit="m/s, rad/s", default=None)


class Path(Message):
    """A sequence of poses: a trajectory travelled (with stamps) or a plan (with or without)."""

    frame: str = scalar("str", "frame of the poses")
    positions: F64 = array("float64", "N 3", "positions along the path", unit="m")
    orientations: F64 | None = array(
        "float64", "N 4", "unit quaternions (x, y, z, w); None where only positions are known", default=None
    )
    stamps: I64 | None = array(
        "int64", "N", "time of each pose, strictly increasing; None if untimed", unit="ns", default=None
    )

    def validate(self) -> None:
        unit_quaternions(self, "orientations")
        if self.stamps is not None and len(self.stamps) > 1:
            wrong = np.flatnonzero(self.stamps[1:] <= self.stamps[:-1])
            if wrong.size:
                i = int(wrong[0]) + 1
                raise MessageError(
                    f"Path.stamps must strictly increase, got {self.stamps[i - 1]} then {self.stamps[i]} at index {i}"
                )

    @property
    def count(self) -> int:
        """Number of poses."""
        return len(self.positions)


class NavSatFix(Message):
    """A position from a satellite receiver, WGS 84. Latitude and longitude are in degrees, as receivers give them: the
    one exception to radians."""

    frame: str = scalar("str", "frame of the antenna", default=ANCHOR)
    status: str = scalar("str", "kind of fix", default="fix", choices=FIX_STATUSES)
    latitude: float = scalar("float", "degrees north, [-90, 90]; NaN without a fix")
    longitude: float = scalar("float", "degrees east, [-180, 180]; NaN without a fix")
    altitude: float = scalar("float", "metres above the WGS 84 ellipsoid; NaN where not known")
    satellites: int | None = scalar("int", "satellites used", default=None)
    covariance_type: str = scalar("str", "how far the covariance is known", default="unknown", choices=COVARIANCE_TYPES)
    covariance: F64 | None = array("float64", "3 3", "of (east, north, up)", unit="m²", default=None)

    def validate(self) -> None:
        fixed = self.status != "no_fix"
        within(self, -90.0, 90.0, "latitude", nan=not fixed)
        within(self, -180.0, 180.0, "longitude", nan=not fixed)


class ParticleSet(Message):
    """The weighted samples of a particle filter."""

    frame: str = scalar("str", "frame of the poses")
    poses: F64 = array("float64", "N 3|N 7", "(x, y, yaw), or (x, y, z, qx, qy, qz, qw)", unit="m, rad")
    weights: F64 = array("float64", "N", "importance weight of each particle, finite and ≥ 0")

    def validate(self) -> None:
        finite(self, "weights")
        within(self, 0.0, np.inf, "weights")
        if self.poses.shape[1] == 7:
            unit_vectors(self, "poses", self.poses[:, 3:], "must end in a unit quaternion (x, y, z, w)")

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.poses)


def _optional(value: npt.ArrayLike | None) -> F64 | None:
    return None if value is None else np.asarray(value, np.float64)
