"""Intrinsics of a camera from views of a board.

Zhang, "A flexible new technique for camera calibration", 2000, by OpenCV: `plumb_bob` and `rational_polynomial`;
Kannala and Brandt's model for `equidistant`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import cv2
import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from dataflow.messages import CameraInfo
from operators.calibration.boards import Board, View
from operators.geometry.pinhole import Pixels, Points

Vectors = NDArray[np.float64]
Model = Literal["plumb_bob", "rational_polynomial", "equidistant"]
MODELS: tuple[Model, ...] = get_args(Model)

MOST = 60
"""Views that are fitted: more take time and change little."""
MOVED = 0.04
"""Share of the image's width by which the corners of two views differ, to count as two."""
BLURRED = 5.0
"""Pixels of an edge from which a view is left out."""
ODD = 3.0
"""Times the median residual from which a view is left out."""

FEW, FEWEST = 12, 4
"""Views below which a calibration is poor, and none is made."""
TILT, TILTED = math.radians(20), 4
"""Angle between board and image plane, and views that have it, without which focal length and distance are one."""
DEEP = 1.4
"""Largest distance of the board over the smallest."""
ROUGH = 1.0
"""Pixels of residual, root mean square."""
LOOSE = 0.005
"""Standard deviation of the focal length, as a share of it."""
LOST = 0.1
"""That from which on there is no calibration."""


@dataclass(frozen=True, eq=False, slots=True)
class CameraCalibration:
    """A camera's calibration.

    `views` are those it is fitted to, with `T_camera_board` (V, 4, 4), `distances` (V,) in metres, the mean depth of
    their corners, `residuals` (N, 2) in pixels of the corners in order, `errors` (V,) their root mean squares.
    `deviations` are standard deviations of fx, fy, cx, cy in pixels; None for a model whose fit gives none. `left_out`
    counts views whose residuals were too large.
    """

    info: CameraInfo
    views: tuple[View, ...]
    T_camera_board: NDArray[np.float64]
    distances: NDArray[np.float64]
    residuals: Pixels
    errors: NDArray[np.float64]
    deviations: NDArray[np.float64] | None
    left_out: int

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, pixels."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))


def different(views: Sequence[View], width: int, most: int = MOST) -> list[View]:
    """Returns the views in order of time without blurred ones and those in which the board has hardly moved since one
    that is taken; of more than `most`, the ones that differ most."""
    sharp = [view for view in views if view.blur <= BLURRED]
    if not sharp:
        return []
    apart = np.full(len(sharp), np.inf)
    order: list[int] = []
    while len(order) < min(most, len(sharp)):
        next_ = int(np.argmax(apart))  # the first of all, then the farthest from those that are taken
        if apart[next_] < MOVED * width:
            break
        order.append(next_)
        apart = np.minimum(apart, [_distance(sharp[next_], view) for view in sharp])
    return [sharp[k] for k in sorted(order)]


def _distance(a: View, b: View) -> float:
    """Returns the mean distance in pixels of corners that both see, infinite without any."""
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    return float(np.linalg.norm(a.pixels[i] - b.pixels[j], axis=1).mean()) if len(i) else float("inf")


def fit_camera(
    board: Board, views: Sequence[View], frame: str, size: tuple[int, int], model: Model
) -> CameraCalibration:
    """Returns the calibration of images of `size` (width, height); views that fit much worse than the others are left
    out once.

    Raises ValueError for fewer than 4 views, and where they determine no camera.
    """
    if len(views) < FEWEST:
        raise ValueError(
            f"usable views of the board: {len(views)}; a calibration takes {FEWEST}, a good one {FEW} or more"
        )
    first = _fit(board, views, frame, size, model)
    keep = first.errors <= ODD * max(float(np.median(first.errors)), 0.1)
    if keep.all() or keep.sum() < FEWEST:
        return first
    fitted = _fit(board, [view for view, kept in zip(views, keep, strict=True) if kept], frame, size, model)
    return replace(fitted, left_out=int((~keep).sum()))


def _fit(board: Board, views: Sequence[View], frame: str, size: tuple[int, int], model: Model) -> CameraCalibration:
    points = [board.points[view.ids] for view in views]
    try:
        K, D, rotations, translations = _solved(points, [view.pixels for view in views], size, model)
    except cv2.error as error:
        raise ValueError(
            f"{len(views)} views determine no {model} camera ({error.err}): the board must tilt"
        ) from error
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    residuals, depths = [], []
    for pose, view, rotation, translation in zip(poses, views, rotations, translations, strict=True):
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(translation)
        seen = board.points[view.ids] @ pose[:3, :3].T + pose[:3, 3]
        residuals.append(view.pixels - projected(seen, K, D, model))
        depths.append(seen[:, 2].mean())
    errors = np.array([np.sqrt((rows**2).sum(axis=1).mean()) for rows in residuals])
    if not np.isfinite(K).all() or not np.isfinite(errors).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise ValueError(f"{len(views)} views determine no {model} camera: the board must tilt, at several distances")
    off = np.concatenate(residuals)
    deviations = None if model == "equidistant" else _deviations(points, rotations, translations, K, D, off)
    if deviations is not None and not max(deviations[:2]) < LOST * min(K[0, 0], K[1, 1]):
        raise ValueError(
            f"{len(views)} views do not determine the focal length (±{max(deviations[:2]):.3g} px): the board must "
            "tilt, at several distances"
        )
    info = CameraInfo(stamp=0, frame=frame, width=size[0], height=size[1], distortion_model=model, K=K, distortion=D)
    return CameraCalibration(info, tuple(views), poses, np.array(depths), off, errors, deviations, 0)


def _deviations(
    points: list[Points], rotations: Vectors, translations: Vectors, K: Vectors, D: Vectors, residuals: Pixels
) -> Vectors:
    """Returns the standard deviations of fx, fy, cx, cy, with the boards' poses and the distortion unknown; infinite
    where nothing determines them. OpenCV's own leave out whatever the views determine worst."""
    information = np.zeros((4 + len(D), 4 + len(D)))
    for seen, rotation, translation in zip(points, rotations, translations, strict=True):
        jacobian = cv2.projectPoints(seen, rotation, translation, K, D)[1]
        pose, camera = jacobian[:, :6], jacobian[:, 6 : 10 + len(D)]
        information += camera.T @ (camera - pose @ np.linalg.lstsq(pose, camera, rcond=None)[0])
    scale = np.sqrt(np.diag(information))
    free = residuals.size - 6 * len(points) - len(information)
    try:
        covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
        return np.asarray(np.sqrt(np.diag(covariance)[:4] * (residuals**2).sum() / free))
    except np.linalg.LinAlgError:
        return np.full(4, np.inf)


def _solved(
    points: list[Points], pixels: list[Pixels], size: tuple[int, int], model: Model
) -> tuple[Vectors, Vectors, Vectors, Vectors]:
    """K, D, and for each view a rotation vector and a translation."""
    if model == "equidistant":
        flags = cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW
        shaped = [p.reshape(1, -1, 3) for p in points], [p.reshape(1, -1, 2) for p in pixels]
        start = np.zeros((3, 3)), np.zeros(4)
        _, K, D, rotations, translations = cv2.fisheye.calibrate(*shaped, size, *start, flags=flags)
        return _float(K), _float(D).ravel()[:4], _float(rotations), _float(translations)
    flags, count = (cv2.CALIB_RATIONAL_MODEL, 8) if model == "rational_polynomial" else (0, 5)
    _, K, D, rotations, translations = cv2.calibrateCamera(
        [p.astype(np.float32) for p in points],
        [p.astype(np.float32) for p in pixels],
        size,
        np.zeros((3, 3)),
        np.zeros(count),
        flags=flags,
    )
    return _float(K), _float(D).ravel()[:count], _float(rotations), _float(translations)


def _float(value: npt.ArrayLike) -> NDArray[np.float64]:
    return np.asarray(value, np.float64)


def projected(points: Points, K: NDArray[np.float64], D: NDArray[np.float64], model: str) -> Pixels:
    """Returns raw pixels (N, 2) of points (N, 3) in the camera's frame."""
    zero = np.zeros(3)
    if model == "equidistant":
        found, _ = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), zero, zero, K, D)
    else:
        found, _ = cv2.projectPoints(points, zero, zero, K, D)
    return np.asarray(found, np.float64).reshape(-1, 2)


def tilts(fitted: CameraCalibration) -> NDArray[np.float64]:
    """Returns the angle between the board and the image plane in each view, radians."""
    return np.asarray(np.arccos(np.clip(np.abs(fitted.T_camera_board[:, 2, 2]), 0, 1)))


def warnings_of(fitted: CameraCalibration) -> list[str]:
    """Returns what makes the calibration poor, each with what would mend it."""
    found = []
    if len(fitted.views) < FEW:
        found.append(f"{len(fitted.views)} views are few: show the board in {FEW} or more places and angles")
    tilted = int((tilts(fitted) >= TILT).sum())
    if tilted < TILTED:
        found.append(
            f"{tilted} views show the board tilted by {math.degrees(TILT):.0f}° or more: focal length and distance are "
            "hard to separate; tilt it both ways"
        )
    near, far = fitted.distances.min(), fitted.distances.max()
    if far < DEEP * near:
        found.append(f"the board was always {near:.2f} to {far:.2f} m away: bring it nearer and take it farther")
    if fitted.rms > ROUGH:
        found.append(
            f"the residual is {fitted.rms:.2f} px: is the board flat, are its counts right, does the lens need another "
            "--model?"
        )
    if fitted.deviations is not None and max(fitted.deviations[:2]) > LOOSE * fitted.info.fx:
        found.append(
            f"the focal length is known to ±{max(fitted.deviations[:2]):.1f} px only: more views, more tilt, more of "
            "the image"
        )
    return found
