"""A keyframe's corners are looked for once more where few of them agree."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.geometry.pinhole import Pixels, project
from operators.odometry.features import LK_LEVELS
from operators.odometry.rgbd import corners
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.corners import followed
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.surface import Surface

K = np.array([[250.0, 0.0, 160.0], [0.0, 250.0, 120.0], [0.0, 0.0, 1.0]])
GRAY = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)


def keyframe() -> tuple[Keyframe, Pixels]:
    """A keyframe of 60 corners, and where a camera sees them that has gone 4 cm aside and 5 cm ahead."""
    rng = np.random.default_rng(1)
    pixels = np.column_stack([rng.uniform(20, 300, 60), rng.uniform(20, 220, 60)])
    depth = rng.uniform(1.5, 4.0, 60)
    points = np.column_stack([(pixels - K[:2, 2]) / K[0, 0] * depth[:, None], depth])
    made = Keyframe(
        0, np.eye(4), np.zeros((6, 6)), GRAY, Surface(np.full((60, 80), 0.5, np.float32), K), pixels, points,
        np.ones(60, np.int64),
    )  # fmt: skip
    return made, project(points - [0.04, 0.0, 0.05], K)


@pytest.mark.parametrize(("astray", "looks"), [(20, [LK_LEVELS]), (40, [LK_LEVELS, 0])])
def test_corners_that_were_led_astray_are_looked_for_near_the_guess(
    astray: int, looks: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    known, there = keyframe()
    asked: list[int] = []

    def track(a: object, b: object, pixels: Pixels, guess: Pixels, levels: int) -> tuple[Pixels, NDArray[np.bool_]]:
        asked.append(levels)
        ends = there.copy()
        if levels:
            ends[:astray] += np.random.default_rng(2).uniform(-60, 60, (astray, 2))
        return ends, np.ones(len(ends), bool)

    monkeypatch.setattr(corners, "track_corners", track)
    fitter = Fitter(RgbdCamera(K, K), RgbdOdometryConfig(), Noise())

    found = followed(GRAY, known, there, fitter)

    assert asked == looks
    assert found is not None
    assert len(found.pixels) >= (60 - astray if len(looks) == 1 else 60)
    assert np.allclose(found.T_world_camera[:3, 3], [0.04, 0.0, 0.05], atol=1e-3)


def test_a_frame_in_which_nothing_is_found_has_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    known, there = keyframe()
    nothing = np.zeros(len(there), bool)
    monkeypatch.setattr(corners, "track_corners", lambda *given: (there, nothing))

    assert followed(GRAY, known, there, Fitter(RgbdCamera(K, K), RgbdOdometryConfig(), Noise())) is None
