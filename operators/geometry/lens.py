"""Lens distortion: pixels of a raw image, normalised coordinates (x / z, y / z) of the rays that they see, and back.

Models are those of CameraInfo: `plumb_bob` and `rational_polynomial` (Brown, "Decentering distortion of lenses", 1966,
as OpenCV has it) and `equidistant` (Kannala and Brandt, "A generic camera model and calibration method for
conventional, wide-angle, and fish-eye lenses", 2006).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import CameraInfo
from dataflow.messages.camera import COEFFICIENTS
from operators.geometry.pinhole import Pixels, unproject
from operators.geometry.se3 import Matrix

Table = NDArray[np.float32]

_MISS = 0.5  # pixels that a ray, projected again, may be off


def is_distorted(info: CameraInfo) -> bool:
    """Returns whether rays bend: any coefficient differs from 0, or the model is not the pinhole's."""
    return info.distortion_model == "equidistant" or (info.distortion is not None and bool(np.any(info.distortion)))


def check_model(port: str, info: CameraInfo) -> None:
    """Raises ValueError where the distortion model is none of those known here."""
    if is_distorted(info) and info.distortion_model not in COEFFICIENTS:
        known = ", ".join(COEFFICIENTS)
        raise ValueError(f"{port}_info has the distortion model {info.distortion_model!r}; known here are {known}")


def check_projection(port: str, info: CameraInfo) -> None:
    """Raises ValueError where P of the rectified camera has no focal lengths: the camera was not calibrated."""
    if info.P is None or not (info.P[0, 0] > 0 and info.P[1, 1] > 0):
        raise ValueError(f"{port}_info must hold P with focal lengths above zero to rectify by, got {info.P}")


def undistorted(pixels: Pixels, info: CameraInfo) -> Pixels:
    """Returns normalised coordinates (N, 2) of raw pixels (N, 2).

    Raises ValueError where the model cannot be inverted there: its coefficients were fitted to another part of the
    image, or rays go sideways or backwards.
    """
    if not is_distorted(info):
        return np.ascontiguousarray(unproject(pixels, info.K)[:, :2])  # as OpenCV takes it
    points = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
    D = _coefficients(info)
    if info.distortion_model == "equidistant":
        found = cv2.fisheye.undistortPoints(points, info.K, D)
    else:
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        found = cv2.undistortPoints(points, info.K, D, criteria=stop)
    rays = np.asarray(found, np.float64).reshape(-1, 2)
    miss = np.linalg.norm(distorted(rays, info) - pixels, axis=1)
    wrong = ~(miss < _MISS) | (np.abs(rays) > 1e3).any(axis=1)
    if wrong.any():
        u, v = np.asarray(pixels)[int(np.flatnonzero(wrong)[0])]
        raise ValueError(
            f"the {info.distortion_model} model of {info.frame!r} has no ray before the camera for pixel "
            f"({u:.0f}, {v:.0f}); it fits only a part of the image"
        )
    return rays


def distorted(rays: Pixels, info: CameraInfo) -> Pixels:
    """Returns raw pixels (N, 2) of normalised coordinates (N, 2)."""
    D = _coefficients(info)
    if info.distortion_model == "equidistant":
        bent = np.asarray(cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), info.K, D), np.float64)
        return bent.reshape(-1, 2)
    points = np.column_stack([rays, np.ones(len(rays))])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), info.K, D)
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def tables(info: CameraInfo, R: Matrix, K: Matrix, size: tuple[int, int]) -> tuple[Table, Table]:
    """Returns the raw column and row (H, W) that every pixel of a pinhole image of `size` (width, height) shows.

    `K` (3, 3) is that image's, `R` (3, 3) its rectification: it maps the raw camera's axes to the image's.
    """
    D = _coefficients(info)
    if info.distortion_model == "equidistant":
        found = cv2.fisheye.initUndistortRectifyMap(info.K, D, R, K, size, cv2.CV_32FC1)
    else:
        found = cv2.initUndistortRectifyMap(info.K, D, R, K, size, cv2.CV_32FC1)
    columns, rows = (np.asarray(table, np.float32) for table in found)
    return columns, rows


def _coefficients(info: CameraInfo) -> NDArray[np.float64]:
    if info.distortion is None or not len(info.distortion):
        return np.zeros(4)
    return np.array(info.distortion, np.float64)
