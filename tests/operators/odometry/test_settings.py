"""The least that settings of odometries may be, and what is refused below it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from operators.odometry.mono.settings import MonoOdometryConfig, RangingConfig
from operators.odometry.mono.tracker import MonoOdometry
from operators.odometry.mono.two_view import TwoViewConfig
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.stereo.adjustment import StereoRig
from operators.odometry.stereo.settings import StereoOdometryConfig

EYE, MIRROR = np.eye(3), np.diag([1.0, 1.0, -1.0, 1.0])


def without(row: int, column: int) -> np.ndarray:
    K = EYE.copy()
    K[row, column] = 0.0
    return K


@pytest.mark.parametrize(
    ("make", "least", "less"),
    [
        (RgbdOdometryConfig, {"min_inliers": 6}, {"min_inliers": 5}),
        (RgbdOdometryConfig, {"corners": 1}, {"corners": 0}),
        (RgbdOdometryConfig, {"keyframes": 1}, {"keyframes": 0}),
        (RgbdOdometryConfig, {"references": 1}, {"references": 0}),
        (RgbdOdometryConfig, {"near": 0.01, "far": 0.02}, {"near": 0.02, "far": 0.02}),
        (RgbdOdometryConfig, {"near": 0.01}, {"near": 0.0}),
        (MonoOdometryConfig, {"min_inliers": 8}, {"min_inliers": 7}),
        (MonoOdometryConfig, {"fixed": 2, "window": 3}, {"fixed": 2, "window": 2}),
        (MonoOdometryConfig, {"fixed": 2}, {"fixed": 1}),
        (MonoOdometryConfig, {"window": 8, "keyframes": 8}, {"window": 8, "keyframes": 7}),
        (RangingConfig, {"near": 1.0, "far": 1.1}, {"near": 1.0, "far": 1.0}),
        (TwoViewConfig, {"min_points": 8}, {"min_points": 7}),
        (TwoViewConfig, {"parallax": 1e-9}, {"parallax": 0.0}),
        (TwoViewConfig, {"sigma": 1e-9}, {"sigma": 0.0}),
        (StereoOdometryConfig, {"min_inliers": 6}, {"min_inliers": 5}),
        (StereoOdometryConfig, {"fixed": 1, "window": 2}, {"fixed": 2, "window": 2}),
        (StereoOdometryConfig, {"fixed": 1}, {"fixed": 0}),
        (StereoRig, {"K": EYE, "baseline": 1e-9}, {"K": EYE, "baseline": 0.0}),
        (StereoRig, {"K": EYE, "baseline": 1.0}, {"K": EYE, "baseline": np.inf}),
        (StereoRig, {"K": EYE, "baseline": 1.0}, {"K": without(0, 0), "baseline": 1.0}),
        (StereoRig, {"K": EYE, "baseline": 1.0}, {"K": without(1, 1), "baseline": 1.0}),
        (StereoRig, {"K": EYE, "baseline": 1.0}, {"K": np.eye(4), "baseline": 1.0}),
        (MonoOdometry, {"K": EYE}, {"K": without(0, 0)}),
        (MonoOdometry, {"K": EYE}, {"K": without(1, 1)}),
        (MonoOdometry, {"K": EYE}, {"K": EYE * np.nan}),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": EYE, "K_depth": EYE[:2]}),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": EYE + np.inf, "K_depth": EYE}),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": np.eye(4), "K_depth": EYE}),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": without(0, 0), "K_depth": EYE}),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": without(1, 1), "K_depth": EYE}),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": np.diag([-1.0, 1.0, 1.0]), "K_depth": EYE}),
        (
            RgbdCamera,
            {"K_color": EYE, "K_depth": EYE},
            {"K_color": EYE, "K_depth": EYE, "T_depth_color": 2 * np.eye(4)},
        ),
        (RgbdCamera, {"K_color": EYE, "K_depth": EYE}, {"K_color": EYE, "K_depth": EYE, "T_depth_color": MIRROR}),
    ],
)
def test_the_least_is_allowed_and_less_is_refused(make: Any, least: dict[str, Any], less: dict[str, Any]) -> None:
    make(**least)
    with pytest.raises(ValueError, match=make.__name__.removesuffix("Odometry")):
        make(**less)


def test_one_odometry_is_of_one_calibration() -> None:
    rig, camera = StereoRig(EYE, 0.5), RgbdCamera(EYE, 2 * EYE)
    rig.check_same(StereoRig(EYE.copy(), 0.5))
    camera.check_same(RgbdCamera(EYE.copy(), 2 * EYE))
    moved = np.eye(4)
    moved[0, 3] = 1e-6
    for known, other in [
        (rig, StereoRig(EYE, 0.51)), (rig, StereoRig(EYE * [[1.1], [1.0], [1.0]], 0.5)),
        (camera, RgbdCamera(2 * EYE, 2 * EYE)), (camera, RgbdCamera(EYE, EYE)),
        (camera, RgbdCamera(EYE, 2 * EYE, moved)),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match="the calibration changed"):
            known.check_same(other)
