"""Which place a lost camera's view is taken for, and what is refused because it only looks like it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.geometry import se3
from operators.monitoring.image_flaws import Watch
from operators.odometry.keyframes import candidates
from operators.odometry.motion import Motion
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.evidence import Evidence, gathered, seeing
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.frame import Frame, observe
from operators.odometry.rgbd.keyframe import Keyframe
from operators.odometry.rgbd.local_map import LocalMap
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.relocalizer import recognised
from operators.odometry.rgbd.settings import RgbdOdometryConfig

FOCAL, WIDTH, HEIGHT = 260.0, 320, 240
K = np.array([[FOCAL, 0.0, 159.5], [0.0, FOCAL, 119.5], [0.0, 0.0, 1.0]])
CAMERA, CONFIG = RgbdCamera(K, K), RgbdOdometryConfig()
WALL = 2.0  # metres
AHEAD = Motion(0, np.eye(4), np.zeros(6))

Shape = NDArray[np.float32]


def pattern(seed: int) -> NDArray[np.uint8]:
    """A wall 1200 pixels wide with spots of every size."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.random((n, 5 * n), np.float32), (1200, HEIGHT), interpolation=cv2.INTER_CUBIC)
        for n in (8, 24, 60)
    ]
    return np.clip((sum(layers) / 3.0 - 0.5) * 400 + 128, 0, 255).astype(np.uint8)


def at(x: int) -> NDArray[np.float64]:
    """T_world_camera where the wall's column x is the first of the image."""
    return se3.exp(np.array([x * WALL / FOCAL, 0.0, 0.0, 0.0, 0.0, 0.0]))


def view(wall: NDArray[np.uint8], x: int, shape: Shape | None = None) -> Frame:
    gray = np.ascontiguousarray(wall[:, x : x + WIDTH])
    depth = np.full((HEIGHT, WIDTH), WALL, np.float32) if shape is None else shape
    return observe(gray, depth, 1_000_000_000, K, K, CONFIG, Watch())


def keyframe(wall: NDArray[np.uint8], x: int, segment: int = 0) -> Keyframe:
    frame, none = view(wall, x), np.zeros((0, 3))
    return Keyframe(
        x, at(x), np.zeros((6, 6)), frame.gray, frame.surface, none[:, :2], none, np.zeros(0, np.int64), segment
    )


def found(
    frame: Frame, keyframes: list[Keyframe], others: list[Keyframe] | None = None
) -> list[tuple[NDArray[np.float64], Keyframe]]:
    """What a view is taken for among keyframes, in a map that may hold others."""
    known = LocalMap(30)
    known.keyframes = keyframes + (others or [])
    fitter = Fitter(CAMERA, CONFIG, Noise(0.5, 1.0))
    return [(fit.T_world_camera, k) for fit, k in recognised(frame, keyframes, fitter, AHEAD, np.eye(4), known)]


def test_a_view_between_keyframes_is_found_where_it_is() -> None:
    wall = pattern(1)
    keyframes = [keyframe(wall, x) for x in (0, 200, 500, 800)]
    ((T, known),) = found(view(wall, 420), keyframes)
    off = se3.log(invert(at(420)) @ T)
    assert np.linalg.norm(off[:3]) < 0.03
    assert known.stamp == 500


def test_a_view_of_another_wall_is_found_nowhere() -> None:
    wall = pattern(1)
    assert found(view(pattern(2), 420), [keyframe(wall, x) for x in (0, 200, 500, 800)]) == []


@pytest.mark.parametrize("twice", [True, False])
def test_a_view_that_fits_another_part_of_the_map_as_well_is_found_nowhere(twice: bool) -> None:
    """The same picture hangs 4.6 m farther on, where no keyframe is chosen."""
    wall = pattern(1)
    if twice:
        wall[:, 600:] = wall[:, :600]
    near, far = [keyframe(wall, x) for x in (0, 200)], [keyframe(wall, x) for x in (600, 800)]
    assert len(found(view(wall, 150), near)) == 1
    assert len(found(view(wall, 150), near, far)) == (not twice)


def test_each_segment_is_looked_into_by_itself() -> None:
    wall, other = pattern(1), pattern(2)
    keyframes = [keyframe(other, 400, 0), keyframe(wall, 400, 1)]
    ((_, known),) = found(view(wall, 420), keyframes)
    assert known.segment == 1


def test_a_like_shape_with_another_pattern_is_not_certain() -> None:
    same, other = keyframe(pattern(1), 400), keyframe(pattern(2), 400)
    frame = view(pattern(1), 420)
    assert gathered(frame, at(420), [same], CAMERA).certain
    alike = gathered(frame, at(420), [other], CAMERA)
    assert alike.agreement > 0.95
    assert alike.likeness < 0.3
    assert not alike.certain


def test_a_like_pattern_of_another_shape_is_not_certain() -> None:
    stepped = np.full((HEIGHT, WIDTH), WALL, np.float32)
    stepped[:, ::80] = 0.0
    for first in range(0, WIDTH, 80):
        stepped[:, first : first + 45] = 2.6
    compared = gathered(view(pattern(1), 400, stepped), at(400), [keyframe(pattern(1), 400)], CAMERA)
    assert compared.likeness > 0.9
    assert compared.agreement < 0.6
    assert not compared.certain


def test_a_view_that_contradicts_the_map_must_look_the_more_like_it() -> None:
    """The first is a bookcase taken for one like it, 1.8 m beside; in the second robots have moved; a right view."""
    assert not Evidence(3507, overlap=0.46, agreement=0.85, likeness=0.58, beside=0.64, contrary=0.18).certain
    assert Evidence(3507, overlap=0.84, agreement=0.79, likeness=0.83, beside=0.75, contrary=0.19).certain
    assert Evidence(3507, overlap=0.52, agreement=0.88, likeness=0.57, beside=0.57, contrary=0.03).certain


def test_object_in_free_space_of_the_map_is_contrary_and_occlusion_is_not() -> None:
    """A crate, 1 m before a third of the wall: in the view or in the map alone, in both, in none."""
    wall, crate = pattern(1), np.full((HEIGHT, WIDTH), WALL, np.float32)
    crate[:, : WIDTH // 3] = WALL - 1.0
    bare = keyframe(wall, 400)
    full = replace(bare, surface=view(wall, 400, crate).surface)
    found = [
        gathered(view(wall, 400, shape), at(400), [known], CAMERA).contrary
        for shape in (crate, None)
        for known in (bare, full)
    ]
    np.testing.assert_allclose(found, [1 / 3, 0, 0, 1 / 3], atol=0.03)


def test_light_that_changes_leaves_a_view_alike() -> None:
    frame = view(pattern(1), 420)
    dark = (frame.gray * 0.5 + 20.0).astype(np.uint8)
    darker = observe(dark, frame.depth, 1_000_000_000, K, K, CONFIG, Watch())
    assert gathered(darker, at(420), [keyframe(pattern(1), 400)], CAMERA).certain


@pytest.mark.parametrize(("x", "overlap"), [(0, 1.0), (160, 0.5), (400, 0.0)])
def test_overlap_is_the_share_of_the_view_that_the_map_saw(x: int, overlap: float) -> None:
    wall = pattern(1)
    assert gathered(view(wall, x), at(x), [keyframe(wall, 0)], CAMERA).overlap == pytest.approx(overlap, abs=0.03)


def test_the_keyframe_that_saw_most_comes_last() -> None:
    wall = pattern(1)
    keyframes = [keyframe(wall, x) for x in (300, 0, 800)]
    points = view(wall, 250).surface.points(4)
    assert [k.stamp for k in seeing(points, at(250), keyframes, 2)] == [0, 300]


def test_all_keyframes_are_tried_within_a_few_frames_and_the_nearest_in_each() -> None:
    wall = pattern(1)
    keyframes = [keyframe(wall, x) for x in range(0, 800, 100)]
    tried = [{k.stamp for k in candidates(keyframes, at(110), 2, 2, turn)} for turn in range(3)]
    assert all({100, 200} <= chosen and len(chosen) == 4 for chosen in tried)
    assert set.union(*tried) == {k.stamp for k in keyframes}
