"""The place of one camera beside another, and the rectification of the pair, from views of a board that both saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo
from dataflow.messages.geometry import invert
from operators.calibration.boards import FEWEST as FEWEST_CORNERS
from operators.calibration.boards import Board, View
from operators.calibration.camera import FEW, FEWEST, ROUGH
from operators.geometry.lens import undistorted
from operators.geometry.pinhole import Pixels
from operators.geometry.se3 import Matrix

SKEWED = 2_000_000
"""Nanoseconds between the images of a pair, median, from which the cameras count as not synchronised."""


@dataclass(frozen=True, eq=False, slots=True)
class Pair:
    """Both cameras' calibrations with R and P, and `T_left_right` (4, 4), which maps the right camera's coordinates to
    the left one's.

    `rms` in pixels of both images, freed from distortion; `rows` (N,) by how many pixels a corner's row in the
    rectified left image differs from that in the right one; `apart` (V,) nanoseconds between the images of each view.
    """

    left: CameraInfo
    right: CameraInfo
    T_left_right: Matrix
    rms: float
    rows: NDArray[np.float64]
    apart: NDArray[np.int64]

    @property
    def baseline(self) -> float:
        """Metres between the cameras."""
        return float(np.linalg.norm(self.T_left_right[:3, 3]))


def paired(left: Sequence[View], right: Sequence[View], tolerance: int) -> list[tuple[View, View]]:
    """Returns views of the two cameras at most `tolerance` ns apart, each the other's nearest, that share 8 corners."""
    stamps = np.array([view.stamp for view in right], np.int64)
    pairs: dict[int, tuple[int, View]] = {}
    for view in left:
        if not len(stamps):
            break
        k = int(np.argmin(np.abs(stamps - view.stamp)))
        apart = abs(int(stamps[k]) - view.stamp)
        if apart <= tolerance and (k not in pairs or apart < pairs[k][0]):
            pairs[k] = apart, view
    found = [(view, right[k]) for k, (_, view) in sorted(pairs.items())]
    return [pair for pair in found if len(np.intersect1d(pair[0].ids, pair[1].ids)) >= FEWEST_CORNERS]


def fit_pair(board: Board, pairs: Sequence[tuple[View, View]], left: CameraInfo, right: CameraInfo) -> Pair:
    """Returns the pair of two calibrated cameras with one model and images of one size.

    Raises ValueError for fewer than 4 views, and where the right camera is not beside the left one.
    """
    if len(pairs) < FEWEST:
        raise ValueError(f"{len(pairs)} views in which both cameras see the board at once; {FEWEST} are needed")
    assert left.distortion is not None
    assert right.distortion is not None
    size = (left.width, left.height)
    shared = [np.intersect1d(a.ids, b.ids, return_indices=True) for a, b in pairs]
    points = [board.points[ids] for ids, _, _ in shared]
    pixels = (
        [a.pixels[i] for (a, _), (_, i, _) in zip(pairs, shared, strict=True)],
        [b.pixels[j] for (_, b), (_, _, j) in zip(pairs, shared, strict=True)],
    )
    rms, R, t = _solved(points, pixels, left, right)
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = R, np.ravel(t)
    if T_right_left[0, 3] >= -abs(T_right_left[1, 3]):
        raise ValueError(
            f"the right camera lies at {np.round(-R.T @ np.ravel(t), 3).tolist()} m in the left one's frame (x right, "
            "y down), not to its right: exchange the streams, or turn the images"
        )
    rectify = cv2.fisheye.stereoRectify if left.distortion_model == "equidistant" else cv2.stereoRectify
    R_left, R_right, P_left, P_right = (
        np.asarray(found, np.float64)
        for found in rectify(
            left.K, left.distortion, right.K, right.distortion, size, R, t, flags=cv2.CALIB_ZERO_DISPARITY
        )[:4]
    )
    infos = left.replace(R=R_left, P=P_left), right.replace(R=R_right, P=P_right)
    rows = np.concatenate([_rows(a, infos[0]) - _rows(b, infos[1]) for a, b in zip(*pixels, strict=True)])
    apart = np.array([abs(a.stamp - b.stamp) for a, b in pairs], np.int64)
    return Pair(*infos, invert(T_right_left), rms, rows, apart)


def _solved(
    points: list[NDArray[np.float64]], pixels: tuple[list[Pixels], list[Pixels]], left: CameraInfo, right: CameraInfo
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """The residual, R (3, 3) and t (3, 1), which map the left camera's coordinates to the right one's, by pixels of
    pinhole cameras: OpenCV's function for fisheye lenses takes no views with different numbers of corners."""
    straight = [
        [np.column_stack([undistorted(one, info), np.ones(len(one))]) @ info.K[:2].T for one in side]
        for side, info in zip(pixels, (left, right), strict=True)
    ]
    rms, *_, R, t, _, _ = cv2.stereoCalibrate(
        [p.astype(np.float32) for p in points],
        [p.astype(np.float32) for p in straight[0]],
        [p.astype(np.float32) for p in straight[1]],
        np.array(left.K), np.zeros(5), np.array(right.K), np.zeros(5), (left.width, left.height),
        flags=cv2.CALIB_FIX_INTRINSIC, criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9),
    )  # fmt: skip
    return float(rms), np.asarray(R, np.float64), np.asarray(t, np.float64)


def _rows(pixels: Pixels, info: CameraInfo) -> NDArray[np.float64]:
    """The rows (N,) of raw pixels (N, 2) in the rectified image."""
    assert info.R is not None
    assert info.P is not None
    rays = undistorted(pixels, info)
    turned = np.column_stack([rays, np.ones(len(rays))]) @ info.R.T
    return np.asarray(turned[:, 1] / turned[:, 2] * info.P[1, 1] + info.P[1, 2])


def warnings_of(pair: Pair) -> list[str]:
    """Returns what makes the pair's calibration poor, each with what would mend it."""
    found = []
    if len(pair.apart) < FEW:
        found.append(f"{len(pair.apart)} views in both cameras at once are few: {FEW} or more are better")
    if pair.rms > ROUGH:
        found.append(
            f"the residual of the pair is {pair.rms:.2f} px: did the board or the cameras move between their images?"
        )
    if (late := float(np.median(pair.apart))) > SKEWED:
        found.append(
            f"the images of a pair are {late * 1e-6:.1f} ms apart: hold the board still for each view, or trigger the "
            "cameras together"
        )
    return found
