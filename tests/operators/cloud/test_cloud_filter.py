"""CloudFilter on clouds whose right outcome is known."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repeated import assert_repeats

from dataflow.messages import PointCloud
from dataflow.testing import play
from operators.cloud import CloudFilter


def cloud(points: object, stamp: int = 1, **fields: object) -> PointCloud:
    return PointCloud(stamp=stamp, frame="lidar", points=np.asarray(points, np.float32).reshape(-1, 3), **fields)


def filtered(given_cloud: PointCloud, **params: object) -> tuple[PointCloud, dict[str, str]]:
    played = play(CloudFilter(**params), {"cloud": [given_cloud]})
    (out,), (status,) = played["filtered"], played["status"]
    return out, status.pairs(0)


def room(seed: int = 0) -> np.ndarray:
    """Points on the faces of a box of 4 x 4 x 2 m around the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (3000, 3))
    points[np.arange(3000), rng.integers(0, 3, 3000)] = rng.choice([-1, 1], 3000)
    return points * [2, 2, 1]


def test_range_and_box_keep_the_points_inside() -> None:
    points = [[0.1, 0, 0], [1, 0, 0], [3, 0, 0], [0, 1, 0], [9, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0]]
    box = {"lower": (0.5, -0.5, -0.5), "upper": (20.0, 0.5, 0.5)}
    out, counts = filtered(cloud(points), min_range=0.5, max_range=5.0, **box)
    assert out.points.tolist() == [[1, 0, 0], [3, 0, 0]]
    assert counts["dropped, not finite"] == "2"
    assert counts["dropped, range"] == "2"
    assert counts["dropped, box"] == "1"
    assert counts["kept"] == "2"


def test_voxel_holds_the_means_of_points_colors_and_intensities() -> None:
    points = [[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.1, 0.1]]
    given_cloud = cloud(
        points,
        colors=np.array([[0, 0, 0], [100, 50, 21], [7, 7, 7]], np.uint8),
        intensities=np.array([1, 3, 9], np.float32),
        rings=np.array([1, 2, 3], np.uint16),
    )
    out, _ = filtered(given_cloud, voxel=0.5)
    np.testing.assert_allclose(out.points, [[-0.1, 0.1, 0.1], [0.2, 0.1, 0.1]], atol=1e-6)
    assert out.colors.tolist() == [[7, 7, 7], [50, 25, 10]]
    assert out.intensities.tolist() == [9, 2]
    assert out.rings is None


def test_filtered_organised_cloud_keeps_precise_coordinates_and_loses_rows() -> None:
    points = np.array([[1.0, 0, 0], [9, 0, 0], [2, 0, 0], [3, 0, 0]])
    out, _ = filtered(cloud(points, precise=points + 1e6, columns=2), max_range=5.0)
    assert (out.columns, out.precise.tolist()) == (None, (points[[0, 2, 3]] + 1e6).tolist())


@given(st.integers(0, 1000), st.floats(0.05, 2.0))
def test_voxels_do_not_depend_on_the_order_of_the_points(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (200, 3)).astype(np.float32)
    one, _ = filtered(cloud(points), voxel=size)
    other, _ = filtered(cloud(rng.permutation(points)), voxel=size)
    np.testing.assert_allclose(one.points, other.points, atol=1e-5)
    cells = np.floor(points.astype(np.float64) / size)
    assert one.count == len(np.unique(cells, axis=0))


@pytest.mark.parametrize(
    "params", [{"outlier_neighbours": 10, "outlier_ratio": 3.0}, {"radius": 0.4, "radius_neighbours": 3}]
)
def test_points_in_mid_air_are_removed_and_surfaces_kept(params: dict[str, object]) -> None:
    surface = room()
    air = np.random.default_rng(1).uniform(-0.6, 0.6, (8, 3))
    air *= 0.6 / np.abs(air).max()
    out, _ = filtered(cloud(np.concatenate([surface, air])), **params)
    left = {tuple(p) for p in out.points.tolist()}
    assert not left & {tuple(p) for p in air.astype(np.float32).tolist()}
    assert out.count > 0.97 * len(surface)


def test_normals_are_those_of_the_surface_and_face_the_sensor() -> None:
    points = room()
    out, _ = filtered(cloud(points), normal_neighbours=12, normal_radius=0.6)
    face = np.abs(points) / [2, 2, 1] >= 1 - 1e-9
    inner = (np.abs(points) < [1.4, 1.4, 0.4]).sum(axis=1) == 2  # away from edges, where two faces meet
    expected = -np.sign(points) * face
    cosine = np.einsum("ij,ij->i", out.normals, expected)[inner]
    assert cosine.min() > 0.999


def test_a_lone_point_has_no_normal() -> None:
    out, _ = filtered(cloud(np.concatenate([room(), [[30.0, 0, 0]]])), normal_neighbours=12, normal_radius=0.6)
    assert np.isnan(out.normals[-1]).all()
    assert np.isfinite(out.normals[:-1]).all()


@pytest.mark.parametrize(
    ("points", "text"),
    [
        (np.zeros((0, 3)), "the cloud is empty"),
        (np.full((4, 3), np.nan), "none of 4 points is left; most went by: not finite"),
        ([[50.0, 0, 0]], "none of 1 points is left; most went by: range"),
    ],
)
def test_nothing_left_is_a_warning_and_an_empty_cloud(points: object, text: str) -> None:
    everything = {"voxel": 0.1, "outlier_neighbours": 5, "radius": 0.1, "normal_neighbours": 8, "max_range": 10.0}
    played = play(CloudFilter(**everything), {"cloud": [cloud(points)]})
    (out,), (status,) = played["filtered"], played["status"]
    assert out.count == 0
    assert status.messages == (text,)
    assert status.levels.tolist() == [1]


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"min_range": 5.0, "max_range": 2.0}, "min_range 5.0 m must be below max_range 2.0 m"),
        ({"lower": (0, 0, 0)}, "a box needs both lower and upper"),
        ({"lower": (0, 0, 0), "upper": (1, 0, 1)}, "holds no point: lower must be below upper"),
        ({"normal_neighbours": 3}, "a normal needs 5 points"),
    ],
)
def test_parameters_that_contradict_each_other_are_named(params: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CloudFilter(**params).setup()


def test_filters_repeat_and_a_restored_one_sums_up_alike() -> None:
    make = partial(CloudFilter, voxel=0.1, outlier_neighbours=8, normal_neighbours=10)
    assert_repeats(make, [(cloud(room(k), stamp=k + 1),) for k in range(2)], 1)
