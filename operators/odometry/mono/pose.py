"""The pose of one camera from points that it sees: RANSAC, then a robust refinement with its information.

A lost camera's view is found among keyframes by SIFT, upright and at one size, which bears what a robot's view changes
by near a place where it has been. Lowe, "Distinctive image features from scale-invariant keypoints", 2004.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import invert, transform_points
from operators.geometry.perspective import agreed_pose
from operators.geometry.pinhole import Pixels, Points, project
from operators.geometry.se3 import Matrix
from operators.odometry.features import Gray, Mask, detect_corners
from operators.odometry.mono.map import MonoMap, View
from operators.odometry.recognition import Description, match
from operators.odometry.rgbd.alignment import PixelTerm, PriorTerm, align

ITERATIONS = 200  # of RANSAC, at most
PATCH = 7.0  # pixels, size of the corners described
CORNERS = 500
FEWEST = 12  # corners by which a view may be recognised
ERROR = 4.0  # pixels by which a recognised corner may be off


@dataclass(frozen=True, eq=False)
class PosedView:
    """T_world_camera, which of the points agree with it, and their information (6, 6)."""

    T_world_camera: Matrix
    agree: Mask
    information: Matrix

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.agree))


def solved(points: Points, pixels: Pixels, K: Matrix, error: float, fewest: int) -> tuple[Matrix, Mask] | None:
    """Returns T_world_camera by RANSAC, and which points (N, 3) agree within an error in pixels; None if too few do."""
    if len(points) < fewest:
        return None
    found = agreed_pose(points, pixels, K, error, ITERATIONS)
    if found is None or len(found[1]) < fewest:
        return None
    agree = np.zeros(len(points), np.bool_)
    agree[found[1]] = True
    return invert(found[0]), agree


def refined(points: Points, pixels: Pixels, T: Matrix, K: Matrix, sigma: float, gate: float) -> PosedView:
    """Returns the pose that fits points (N, 3) best, and those within `gate` standard deviations of it."""
    term = PixelTerm(points, pixels, K, np.eye(4), sigma, 1.0)
    found = align(T, (term,), PriorTerm(T, 1e-6 * np.eye(6)), 10)
    T = found.T_world_camera
    local = transform_points(invert(T), points)
    off = project(local, K) - pixels
    agree = (local[:, 2] > 0) & ((off**2).sum(axis=1) < (gate * sigma) ** 2)
    return PosedView(T, np.asarray(agree, np.bool_), found.information)


def described(gray: Gray, pixels: Pixels) -> tuple[Description, NDArray[np.int64]]:
    """Returns the descriptors of corners (N, 2), and which of them have one."""
    keypoints = [cv2.KeyPoint(float(x), float(y), PATCH, 0.0, 0, 0, i) for i, (x, y) in enumerate(pixels.tolist())]
    kept, descriptors = cv2.SIFT.create().compute(gray, keypoints)
    if descriptors is None:
        return Description(np.zeros((0, 2)), np.zeros((0, 128), np.uint8)), np.zeros(0, np.int64)
    rows = np.array([k.class_id for k in kept], np.int64)
    return Description(pixels[rows], descriptors.astype(np.uint8)), rows


def recognised(gray: Gray, known: MonoMap, views: Sequence[View], K: Matrix) -> tuple[Matrix, View] | None:
    """Returns T_world_camera of a view and the keyframe that it was recognised by, if it was."""
    corners = detect_corners(gray, CORNERS)
    seen, _ = described(gray, corners)
    best: tuple[int, Matrix, View] | None = None
    for view in views:
        _, points, pixels = known.seen_in(view)
        mine, rows = described(view.gray, pixels)
        pairs = match(mine, seen)
        if len(pairs) < FEWEST:
            continue
        chosen: Points = points[rows[pairs[:, 0]]]
        found = solved(chosen, seen.pixels[pairs[:, 1]], K, ERROR, FEWEST)
        if found is not None and found[1].sum() > max(0.3 * len(pairs), 0 if best is None else best[0]):
            best = int(found[1].sum()), found[0], view
    return None if best is None else best[1:]
