"""Depth images as grids of patches, and the points of a second camera's pixels, of surfaces that are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from operators.geometry import se3
from operators.geometry.pinhole import project, unproject
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.relocalizer import lifted
from operators.odometry.rgbd.surface import DepthNoise, Surface, scaled_intrinsics

Array = NDArray[np.float64]

K = np.array([[280.0, 0.0, 157.5], [0.0, 270.0, 121.0], [0.0, 0.0, 1.0]])
HEIGHT, WIDTH = 240, 320
NORMAL = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])  # towards the camera
DISTANCE = -2.0  # n·p of the wall's points


def rays(K: Array = K, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> Array:
    """(H, W, 3) with z = 1."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return unproject(np.column_stack([u.ravel(), v.ravel()]).astype(float), K).reshape(*shape, 3)


def wall(normal: Array = NORMAL, distance: float = DISTANCE) -> NDArray[np.float32]:
    return np.asarray(distance / (rays() @ normal), np.float32)


def planes(surface: Surface) -> Array:
    """(h, w, 4)"""
    h, w = surface.inverse_depth.shape
    bordered = surface.bordered_planes.reshape(h + 2, w + 2, 4).astype(float)
    assert not bordered[[0, -1]].any()
    assert not bordered[:, [0, -1]].any()
    return bordered[1:-1, 1:-1]


@pytest.mark.parametrize("block", [2, 3])
def test_patches_of_a_slanted_wall_lie_on_it_and_face_as_it_does(block: int) -> None:
    surface = Surface.from_depth(wall(), K, 0.3, 6.0, block)
    assert surface.inverse_depth.shape == (HEIGHT // block, WIDTH // block)
    assert surface.coverage == 1.0
    for stride in (1, 4):
        points = surface.points(stride)
        assert len(points) == -(-(HEIGHT // block) // stride) * -(-(WIDTH // block) // stride)
        np.testing.assert_allclose(points @ NORMAL, DISTANCE, atol=1e-4)
    found = planes(surface)[1:-1, 1:-1]
    np.testing.assert_allclose(found[..., :3], np.broadcast_to(NORMAL, found[..., :3].shape), atol=2e-3)
    np.testing.assert_allclose(found[..., 3], DISTANCE, atol=4e-3)


def test_a_pixel_of_a_smaller_image_is_the_middle_of_those_it_stands_for() -> None:
    middle = np.array([[10.5, 20.5]])  # of pixels 9 to 12 and 19 to 22
    small = scaled_intrinsics(K, 0.25)
    np.testing.assert_allclose(unproject((middle + 0.5) / 4 - 0.5, small), unproject(middle, K))


def test_patches_beside_a_hole_or_at_the_border_have_no_direction() -> None:
    depth = wall()
    depth[100:112, 60:72] = 0.0
    surface = Surface.from_depth(depth, K, 0.3, 6.0, 2)
    faced = planes(surface)[..., 3] != 0
    expected = np.pad(np.ones((HEIGHT // 2 - 2, WIDTH // 2 - 2), bool), 1)
    expected[49:57, 29:37] = False
    np.testing.assert_array_equal(faced, expected)
    assert np.count_nonzero(surface.inverse_depth == 0) == 36
    assert surface.depth[50, 30] == 0.0
    assert surface.coverage == pytest.approx(1 - 36 / (120 * 160))


def test_an_edge_between_two_surfaces_gives_no_point_of_neither() -> None:
    """Its column lies within a block, of which one pixel sees the nearer wall."""
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    depth[:, :101] = 2.0
    surface = Surface.from_depth(depth, K, 0.3, 6.0, 2)
    assert sorted(np.unique(surface.depth.round(3)).tolist()) == [0.0, 2.0, 3.0]
    assert not surface.inverse_depth[:, 50].any()
    step = Surface.from_depth(np.where(np.arange(WIDTH) < 100, depth, np.float32(3.0)), K, 0.3, 6.0, 2)
    assert step.coverage == 1.0
    assert not planes(step)[:, 49:51].any()
    assert planes(step)[1:-1, 1:48, 3].all()


@pytest.mark.parametrize(("degrees", "seen"), [(70.0, True), (88.0, False)])
def test_a_surface_seen_at_a_grazing_angle_has_no_direction(degrees: float, seen: bool) -> None:
    normal = np.array([0.0, -np.sin(np.radians(degrees)), -np.cos(np.radians(degrees))])
    depth = np.where(rays() @ normal < -1e-3, wall(normal, -0.4), np.float32(0))
    surface, ahead = Surface.from_depth(depth, K, 0.3, 20.0, 2), np.s_[64:68, 40:120]
    assert surface.inverse_depth[ahead].all()
    faced = planes(surface)[ahead][..., 3] != 0
    assert faced.all() if seen else not faced.any()


def test_invalid_or_out_of_range_depth_is_no_return() -> None:
    depth = wall()
    depth[:20], depth[20:40], depth[40:60], depth[60:80] = np.nan, 0.2, 6.1, 0.0
    surface = Surface.from_depth(depth, K, 0.3, 6.0, 2)
    assert not surface.inverse_depth[:40].any()
    assert surface.inverse_depth[40:].all()
    assert surface.typical_depth == pytest.approx(np.median(depth[80:]), abs=0.01)
    nothing = Surface.from_depth(np.zeros_like(depth), K, 0.3, 6.0, 2)
    assert (nothing.coverage, nothing.typical_depth, len(nothing.points())) == (0.0, 2.0, 0)


def test_where_returns_are_sparse_patches_are_larger_so_that_each_has_some() -> None:
    """One pixel in twelve, as of a solid-state LiDAR whose depths are drawn into an image."""
    drawn = np.random.default_rng(0).random((HEIGHT, WIDTH))
    sparse, dense = (
        Surface.from_depth(np.where(drawn < share, wall(), np.float32(0)), K, 0.3, 6.0, 2) for share in (1 / 12, 0.7)
    )
    assert sparse.inverse_depth.shape == (HEIGHT // 8, WIDTH // 8)
    assert sparse.coverage > 0.95
    np.testing.assert_allclose(sparse.points() @ NORMAL, DISTANCE, atol=0.06)
    assert dense.inverse_depth.shape == (HEIGHT // 2, WIDTH // 2)


def test_patches_of_one_pixel_stay_so_where_most_pixels_have_returns() -> None:
    """As of a depth camera of 160 x 120 pixels, which has none to spare."""
    drawn, depth = np.random.default_rng(0).random((HEIGHT, WIDTH)), wall()
    whole = Surface.from_depth(depth, K, 0.3, 6.0, 1)
    np.testing.assert_allclose(whole.depth, depth, rtol=1e-6)
    np.testing.assert_array_equal(whole.K, K)
    holed, sparse = (
        Surface.from_depth(np.where(drawn < share, depth, np.float32(0)), K, 0.3, 6.0, 1) for share in (0.8, 0.5)
    )
    assert holed.inverse_depth.shape == (HEIGHT, WIDTH)
    assert sparse.inverse_depth.shape == (HEIGHT // 4, WIDTH // 4)


def test_depth_noise_grows_with_the_square_of_the_depth() -> None:
    np.testing.assert_allclose(DepthNoise(0.001, 0.003).sigma(np.array([0.0, 1.0, 4.0])), [0.001, 0.004, 0.049])


# -- the points of another camera's pixels -------------------------------------------------------------------

K_COLOR = np.array([[500.0, 0.0, 310.0], [0.0, 490.0, 245.0], [0.0, 0.0, 1.0]])
T_DEPTH_COLOR = se3.exp(np.array([0.06, -0.01, 0.02, 0.02, -0.05, 0.03]))
CAMERA = RgbdCamera(K_COLOR, K, T_DEPTH_COLOR)


def seen_by_color(pixels: Array) -> Array:
    """The points (N, 3), in the depth camera, of the wall that colour pixels (N, 2) see."""
    ways = unproject(pixels, K_COLOR) @ T_DEPTH_COLOR[:3, :3].T
    origin = T_DEPTH_COLOR[:3, 3]
    return origin + ways * ((DISTANCE - origin @ NORMAL) / (ways @ NORMAL))[:, None]


def within(points: Array, border: float) -> NDArray[np.bool_]:
    """Which of the points (N, 3) lie in the depth image, and so far from its border, in pixels."""
    u, v = project(points, K).T
    return (u > border) & (v > border) & (u < WIDTH - 1 - border) & (v < HEIGHT - 1 - border)


def test_a_colour_pixel_has_the_depth_of_the_surface_that_it_sees() -> None:
    pixels = np.random.default_rng(1).uniform(0, 600, (300, 2))
    truth = seen_by_color(pixels)
    for points, known in (
        CAMERA.depth_at(pixels, wall(), 0.3, 6.0),
        lifted(pixels, Surface.from_depth(wall(), K, 0.3, 6.0, 2), CAMERA),
    ):
        assert known[within(truth, 3.0)].all()
        assert not known[~within(truth, -3.0)].any()
        assert np.count_nonzero(known) > 100
        np.testing.assert_allclose(points[known], truth[known], atol=0.01)


def test_a_camera_that_sees_its_own_depth_reads_it_where_it_is() -> None:
    pixels = np.random.default_rng(1).uniform(2, 230, (50, 2))
    points, known = RgbdCamera(K, K).depth_at(pixels, wall(), 0.3, 6.0)
    assert known.all()
    np.testing.assert_allclose(project(points, K), pixels, atol=1e-9)
    np.testing.assert_allclose(points @ NORMAL, DISTANCE, atol=0.01)


@pytest.mark.parametrize(
    ("spoilt", "known"), [(0, True), (1, True), (4, False), (9, False)], ids=["none", "one", "half", "all"]
)
@pytest.mark.parametrize("value", [0.0, np.nan, 9.0])
def test_a_pixel_with_holes_around_it_is_known_by_the_others_if_these_are_most(
    spoilt: int, known: bool, value: float
) -> None:
    depth, camera = np.full((HEIGHT, WIDTH), 2.0, np.float32), RgbdCamera(K, K)
    around = [(v, u) for v in (99, 100, 101) for u in (49, 50, 51) if (v, u) != (100, 50)] + [(100, 50)]
    for v, u in around[:spoilt]:
        depth[v, u] = value
    points, told = camera.depth_at(np.array([[50.0, 100.0]]), depth, 0.3, 6.0)
    assert told.tolist() == [known]
    assert not known or points[0, 2] == pytest.approx(2.0)


def test_a_pixel_beside_an_edge_is_unknown_and_one_on_a_steep_wall_is_known() -> None:
    u = np.arange(WIDTH, dtype=np.float32)
    edge = np.broadcast_to(np.where(u < 50, np.float32(2.0), np.float32(2.2)), (HEIGHT, WIDTH)).astype(np.float32)
    steep = np.broadcast_to(2.0 + 0.02 * u, (HEIGHT, WIDTH)).astype(np.float32)
    at = np.array([[48.0, 100.0], [49.0, 100.0], [50.0, 100.0], [51.0, 100.0]])
    assert RgbdCamera(K, K).depth_at(at, edge, 0.3, 6.0)[1].tolist() == [True, False, False, True]
    assert RgbdCamera(K, K).depth_at(at, steep, 0.3, 6.0)[1].all()
