"""The pose of a camera from points that it sees, most of which are where they are taken to be."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, Points
from operators.geometry.se3 import Matrix

CONFIDENCE = 0.999
FEWEST = 5  # points: three give a pose, a fourth decides which of four it is, and the next is the first to confirm it


def agreed_pose(
    points: Points, pixels: Pixels, K: Matrix, error: float, iterations: int
) -> tuple[Matrix, NDArray[np.intp]] | None:
    """Returns T_camera_world (4, 4) that most points (N, 3) agree with, seen at pixels (N, 2) by a camera K (3, 3), and
    the indices (M,) of those within an error in pixels of the pose that was drawn; None where no pose is found.

    RANSAC (Fischler and Bolles, 1981) over poses of three points (Ke and Roumeliotis, 2017), which OpenCV seeds alike
    at every call. The pose is then fitted to all that agree by SQPnP (Terzakis and Lourakis, 2020): EPnP, which OpenCV
    fits it with, is metres off at times, where the points lie nearly in a plane.
    """
    if len(points) < FEWEST:
        return None
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points, pixels, K, None, iterationsCount=iterations, reprojectionError=error, confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not found or inliers is None:
        return None
    agree = inliers.ravel().astype(np.intp)
    fitted, *pose = cv2.solvePnP(points[agree], pixels[agree], K, None, flags=cv2.SOLVEPNP_SQPNP)
    if fitted:
        rotation, translation = pose
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = cv2.Rodrigues(rotation)[0]
    T_camera_world[:3, 3] = translation.ravel()
    return T_camera_world, agree
