"""The rotation between a camera and an IMU, and the offset of their clocks, by the rates at which both turn.

The camera's turning from one image to another is that of its pose before a board, the IMU's is its gyroscope,
integrated. Rotation, offset and bias that make both alike are found as in Furgale, Rehder and Siegwart, "Unified
temporal and spatial calibration for multi-sensor systems", 2013, without positions: the camera's place is not found.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from dataflow.messages import CameraInfo
from operators.calibration.boards import Board, View
from operators.geometry.lens import undistorted
from operators.geometry.se3 import Matrix, nearest_rotation

Array = NDArray[np.float64]

MOST = 0.5
"""Seconds of offset that are looked for."""
LONGEST = 0.25
"""Seconds between two views of the board, above which the turning before does not count with that after."""
SPAN = 0.4
"""Seconds over which a turn is taken: it grows with the span, the error of its two poses does not."""
ODD = 3.0
"""Times the median error at which the pose before a board is not believed."""
FEWEST = 40
"""Pairs of images."""
ALIKE = 0.7
"""Share of the turning, squared, that must fit."""
LITTLE = math.radians(10)
"""rad/s, root mean square about the axis of least turning, from which the rotation about all axes is well known."""
LOOSE, LATE = math.radians(0.5), 0.002
"""Standard deviations of the rotation and of the offset (s) from which they are poor."""
SLOW = 50.0
"""Hz, of the IMU."""


@dataclass(frozen=True, eq=False, slots=True)
class Turning:
    """Turns (N, 3) of the camera, rotation vectors in its frame, from `begins` to `ends` (N,), seconds."""

    begins: Array
    ends: Array
    turns: Array


@dataclass(frozen=True, eq=False, slots=True)
class CameraImuCalibration:
    """The camera beside the IMU.

    `R_imu_camera` (3, 3) maps the camera's coordinates to the IMU's, `offset` is by how many seconds the images' stamps
    are later than those of the IMU for the same moment, `bias` (3,) the gyroscope's in rad/s. Deviations are standard
    deviations, of the rotation in radians about its worst axis. `residual` in rad/s is the root mean square of what is
    left, `turning` (3,) that of the turning itself about its principal axes, the largest first; `pairs` of images.
    """

    R_imu_camera: Matrix
    offset: float
    bias: Array
    rotation_deviation: float
    offset_deviation: float
    residual: float
    turning: Array
    pairs: int
    rate: float
    """Of the IMU, Hz."""


def turning_of(board: Board, views: Sequence[View], info: CameraInfo, origin: int) -> Turning:
    """Returns the camera's turning between views, whose stamps count from `origin` (ns)."""
    posed = [(view.stamp, *_rotation(board, view, info)) for view in views]
    if not posed:
        return Turning(np.zeros(0), np.zeros(0), np.zeros((0, 3)))
    sure = ODD * float(np.median([error for _, _, error in posed]))
    kept = [(stamp, R) for stamp, R, error in posed if error <= sure]
    seconds = np.array([(stamp - origin) * 1e-9 for stamp, _ in kept])
    R_camera_board = np.array([R for _, R in kept])
    gaps = np.concatenate([[0], np.cumsum(np.diff(seconds) > LONGEST)])
    last = np.searchsorted(seconds, seconds + SPAN, side="right") - 1
    first = np.flatnonzero((gaps[last] == gaps) & (seconds[last] - seconds > SPAN / 2))
    last = last[first]
    turns = R_camera_board[first] @ R_camera_board[last].transpose(
        0, 2, 1
    )  # the camera's axes at the end, in those before
    return Turning(seconds[first], seconds[last], Rotation.from_matrix(turns).as_rotvec())


def _rotation(board: Board, view: View, info: CameraInfo) -> tuple[Matrix, float]:
    """R_camera_board (3, 3) and its error, in normalised coordinates."""
    rays = undistorted(view.pixels, info)
    _, rotations, _, errors = cv2.solvePnPGeneric(
        board.points[view.ids], rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    best = int(np.argmin(np.ravel(errors)))
    return np.asarray(cv2.Rodrigues(rotations[best])[0], np.float64), float(np.ravel(errors)[best])


class _Gyroscope:
    """A gyroscope's samples, integrated: `seconds` (M,), `rates` (M, 3)."""

    def __init__(self, seconds: Array, rates: Array) -> None:
        means = (rates[1:] + rates[:-1]) / 2 * np.diff(seconds)[:, None]
        reached = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), means]))
        ahead = 1
        while ahead < len(seconds):  # each is the product of `ahead` steps up to it, or of all
            reached = Rotation.concatenate([reached[:ahead], reached[:-ahead] * reached[ahead:]])
            ahead *= 2
        self.begin, self.end = float(seconds[0]), float(seconds[-1])
        self._at = Slerp(seconds, reached)

    def turns(self, begins: Array, ends: Array) -> Array:
        """Rotation vectors (N, 3), in the IMU's frame; moments outside count as its first and last."""
        first, last = (self._at(np.clip(t, self.begin, self.end)) for t in (begins, ends))
        return np.asarray((first.inv() * last).as_rotvec(), np.float64)


def fit_mount(camera: Turning, seconds: Array, rates: Array) -> CameraImuCalibration:
    """Returns how the camera is mounted beside a gyroscope with samples (M, 3) in rad/s at `seconds` (M,).

    Raises ValueError where too little was seen, or the two do not turn alike.
    """
    if len(camera.turns) < FEWEST or len(seconds) < FEWEST:
        raise ValueError(
            f"{len(camera.turns)} pairs of images with the board and {len(seconds)} samples of the IMU: {FEWEST} of "
            "each are needed; the board must stay in sight while the camera turns"
        )
    gyroscope = _Gyroscope(seconds, rates)
    inside = (camera.begins - MOST >= gyroscope.begin) & (camera.ends + MOST <= gyroscope.end)
    if inside.sum() >= FEWEST:  # every offset that is tried is judged by the same images
        camera = Turning(camera.begins[inside], camera.ends[inside], camera.turns[inside])
    lasts = camera.ends - camera.begins
    rates_seen = camera.turns / lasts[:, None]

    def moved(offset: float) -> Array:
        return gyroscope.turns(camera.begins - offset, camera.ends - offset)

    step = 0.5 * float(np.median(np.diff(camera.begins)))
    offsets = np.arange(-MOST, MOST + step, step)
    starts = [_aligned(camera.turns, moved(offset)) for offset in offsets]
    best = int(np.argmin([left for _, left in starts]))
    R_start = starts[best][0]

    def left(x: Array) -> Array:
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ R_start
        return np.asarray(moved(offsets[best] + x[6]) / lasts[:, None] - x[3:6] - rates_seen @ R.T).ravel()

    start = np.zeros(7)  # exactly: the first step that is tried is as long as what it is added to, unless that is 0
    spread = max(1.5 * float(np.median(np.abs(left(start)))), 1e-4)
    found = least_squares(left, start, loss="soft_l1", f_scale=spread, x_scale=np.array([1, 1, 1, 1, 1, 1, step]))
    rest = left(found.x)
    offset = float(offsets[best] + found.x[6])
    likeness = 1 - float(rest @ rest) / float((rates_seen**2).sum())
    if likeness < ALIKE or abs(offset) > MOST:
        raise ValueError(
            f"camera and IMU do not turn alike within ±{MOST:g} s ({100 * max(likeness, 0):.0f} % of it fits): "
            "is it the IMU of this camera, and was the board fixed?"
        )
    noise = (1.4826 * float(np.median(np.abs(rest)))) ** 2
    covariance = noise * np.linalg.pinv(found.jac.T @ found.jac)
    return CameraImuCalibration(
        R_imu_camera=nearest_rotation(Rotation.from_rotvec(found.x[:3]).as_matrix() @ R_start),
        offset=offset,
        bias=found.x[3:6],
        rotation_deviation=float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        offset_deviation=float(np.sqrt(covariance[6, 6])),
        residual=float(np.sqrt((rest**2).mean() * 3)),
        turning=np.asarray(np.linalg.svd(rates_seen, compute_uv=False)) / math.sqrt(len(lasts)),
        pairs=len(lasts),
        rate=1 / float(np.median(np.diff(seconds))),
    )


def _aligned(camera: Array, imu: Array) -> tuple[Matrix, float]:
    """R_imu_camera (3, 3) that makes turns (N, 3) most alike, and the sum of squares that is left (Kabsch, 1976); the
    means are the gyroscope's bias."""
    a, b = camera - camera.mean(axis=0), imu - imu.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return R, float(((b - a @ R.T) ** 2).sum())


def warnings_of(mounted: CameraImuCalibration) -> list[str]:
    """Returns what makes the calibration poor, each with what would mend it."""
    found = []
    if mounted.turning[2] < LITTLE:
        found.append(
            f"it turned by {math.degrees(mounted.turning[2]):.1f}°/s only about one axis: turn it about all three, "
            "quickly, with the board in sight"
        )
    if mounted.rotation_deviation > LOOSE:
        found.append(f"the rotation is known to ±{math.degrees(mounted.rotation_deviation):.2f}° only: turn it more")
    if mounted.offset_deviation > LATE:
        found.append(
            f"the offset is known to ±{1e3 * mounted.offset_deviation:.1f} ms only: turn it back and forth, faster"
        )
    if mounted.rate < SLOW:
        found.append(f"the IMU has {mounted.rate:.0f} samples a second: {SLOW:.0f} or more show fast turning")
    return found
