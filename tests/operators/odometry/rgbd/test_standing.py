"""What a recognised view is placed by, where something has moved while nothing was seen."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.odometry.consensus import consensus
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter, Sighting
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.standing import standing

Array = NDArray[np.float64]

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
FITTER = Fitter(RgbdCamera(K, K), RgbdOdometryConfig(), Noise(0.4, 0.5))
MADE = np.random.default_rng(5)
PICTURE = MADE.uniform((-0.2, -1.6, 4.0), (1.6, -0.3, 4.0), (44, 3))  # on a far wall
ROBOT = MADE.uniform((0.4, -0.2, 1.9), (0.8, 0.6, 2.1), (30, 3))  # before it


def seen(known: Array, there: Array) -> tuple[Sighting, Array]:
    """What agrees by a decimetre among points of the map and where a camera at the origin sees them."""
    rng = np.random.default_rng(6)
    known = known + rng.normal(0, 0.005, known.shape)
    pixels = project(there, K) + rng.normal(0, 0.3, (len(there), 2))
    first = consensus(known, there, np.arange(len(there)))[0]
    ages = np.zeros(first.count, np.int64)
    sighting = Sighting(first.T_a_b, known[first.agree], pixels[first.agree], ages, len(there), recognised=True)
    return sighting, there[first.agree]


def off(sighting: Sighting) -> float:
    return float(np.linalg.norm(se3.log(sighting.T_world_camera)[:3]))


@pytest.mark.parametrize("moved", [(0.25, 0.0, 0.0), (0.2, 0.0, 0.15), (-0.3, 0.0, 0.1)])
def test_a_body_that_has_moved_does_not_draw_the_pose_along(moved: tuple[float, float, float]) -> None:
    both, points = seen(np.concatenate([PICTURE, ROBOT - moved]), np.concatenate([PICTURE, ROBOT]))
    assert np.count_nonzero(points[:, 2] < 3.0) >= 8
    assert off(both) > 0.2
    still = standing(both, points, FITTER, 8)
    assert off(still) < 0.4 * off(both)
    assert still.recognised
    assert still.points_world[:, 2].min() > 3.0
    assert len(still.contrary) >= 8
    assert still.contrary[:, 2].max() < 3.0


def test_where_nothing_has_moved_nothing_is_contrary() -> None:
    both, points = seen(np.concatenate([PICTURE, ROBOT]), np.concatenate([PICTURE, ROBOT]))
    still = standing(both, points, FITTER, 8)
    assert off(still) < 0.05
    assert len(still.contrary) == 0
    assert len(still.pixels) > 0.9 * len(both.pixels)


def test_features_that_agree_on_no_pose_stay_as_they_are() -> None:
    few, points = seen(PICTURE[:6], PICTURE[:6])
    assert standing(few, points, FITTER, 8) is few
