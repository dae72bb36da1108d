"""Clusterer on groups of points whose partition and shapes are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repeated import assert_repeats

from dataflow.messages import Boxes3D, Clusters, PointCloud, Pose
from dataflow.messages.geometry import quaternion_from_yaw
from dataflow.testing import play
from operators.cloud import Clusterer
from operators.cloud.clustering import dbscan


def cloud(points: np.ndarray, stamp: int = 1) -> PointCloud:
    return PointCloud(stamp=stamp, frame="camera", points=points.astype(np.float32))


def bar(center: Any, size: Any, yaw: float, count: int, seed: int = 0) -> np.ndarray:
    """Points in a solid box turned about z."""
    own = np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * size
    c, s = np.cos(yaw), np.sin(yaw)
    return own @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]).T + center


def clustered(points: np.ndarray, **params: Any) -> tuple[Clusters, Boxes3D, np.ndarray, dict[str, str]]:
    played = play(Clusterer(**params), {"cloud": [cloud(points)]})
    (clusters,), (boxes,), (features,), (status,) = (played[p] for p in ("clusters", "boxes", "features", "status"))
    return clusters, boxes, features.vectors, status.pairs(0)


def test_groups_are_separated_and_boxed() -> None:
    parts = [bar((1, 0, 0.5), (0.6, 0.2, 0.3), 0.5, 3000), bar((2, 1, 0.2), (0.3, 0.3, 0.4), 0, 3000)]
    noise = np.array([[5.0, 5, 5], [-4, 2, 1], [np.nan, 0, 0]])
    clusters, boxes, features, counts = clustered(np.concatenate([*parts, noise]))
    assert clusters.labels.tolist() == [0] * 3000 + [1] * 3000 + [-1] * 3
    np.testing.assert_allclose(clusters.centroids, [p.mean(axis=0) for p in parts], atol=1e-5)
    np.testing.assert_allclose(boxes.centers, [[1, 0, 0.5], [2, 1, 0.2]], atol=0.02)
    assert sorted(boxes.sizes[0]) == pytest.approx([0.2, 0.3, 0.6], abs=0.03)
    assert boxes.sizes[0, 2] == pytest.approx(0.3, abs=0.01)
    assert boxes.point_counts.tolist() == [3000, 3000]
    np.testing.assert_allclose(features[:, 0], [0.036, 0.036], rtol=0.12)
    assert (counts["points in none"], counts["not finite"]) == ("2", "1")


@pytest.mark.parametrize(
    ("size", "shape"),
    [((2.0, 0.02, 0.02), [1, 0, 0]), ((1.0, 1.0, 0.01), [0, 1, 0]), ((0.5, 0.5, 0.5), [0, 0, 1])],
    ids=["a pole", "a board", "a cube"],
)
def test_linearity_planarity_and_sphericity_name_the_shape(size: Any, shape: list[float]) -> None:
    _, _, features, _ = clustered(bar((2, 0, 0), size, 0.3, 6000))
    np.testing.assert_allclose(features[0, 1:], shape, atol=0.1)
    assert features[0, 1:].sum() == pytest.approx(1, abs=1e-5)


def test_boxes_stand_upright_on_the_gravity_of_the_pose() -> None:
    tilted = Pose(
        stamp=1, frame="world", child_frame="camera", position=[0, 0, 1], orientation=[np.sin(0.4), 0, 0, np.cos(0.4)]
    )
    R = tilted.matrix()[:3, :3]
    points = bar((2, 0, 0), (0.5, 0.2, 0.8), 0.3, 4000) @ R  # upright in the world, seen from the camera
    played = play(Clusterer(), {"cloud": [cloud(points)], "pose": [tilted]})
    (boxes,) = played["boxes"]
    assert boxes.sizes[0, 2] == pytest.approx(0.8, abs=0.02)
    assert sorted(boxes.sizes[0, :2]) == pytest.approx([0.2, 0.5], abs=0.03)


@given(st.integers(0, 500))
def test_the_partition_does_not_depend_on_the_order_of_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (120, 3))
    order = rng.permutation(120)
    weights = np.ones(120, np.intp)
    one, other = dbscan(points, 0.15, 4, weights), dbscan(points[order], 0.15, 4, weights)
    pairs = set(zip(one[order].tolist(), other.tolist(), strict=True))
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


@given(st.integers(0, 500), st.sampled_from([(0.2, 0.2), (0.05, 0.6)]))
def test_clusters_are_those_of_the_definition(seed: int, reaches: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    points, reach = rng.uniform(0, 1, (60, 3)), rng.uniform(*reaches, 60)
    labels = dbscan(points, reach, 4, np.ones(60, np.intp))
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = distance <= np.minimum(reach[:, None], reach[None])
    core = near.sum(axis=1) >= 4
    assert (labels[core] >= 0).all()
    same = labels[:, None] == labels[None]
    assert same[near & core[:, None] & core[None]].all()
    joins = ((distance <= reach[:, None]) & core[None]).any(axis=1)
    assert ((labels >= 0) == (core | joins)).all()


def test_far_points_are_neighbours_at_a_longer_distance_than_near_ones() -> None:
    pair = np.concatenate([bar((0, y, 0), (0.05, 0.05, 0.05), 0, 400) for y in (0, 0.15)])
    clusters, _, _, _ = clustered(np.concatenate([pair + np.array([x, 0, 0]) for x in (1.0, 6.0)]))
    assert clusters.labels.tolist() == [0] * 400 + [1] * 400 + [2] * 800


def test_small_and_large_clusters_are_left_out() -> None:
    points = np.concatenate([bar((k, 0, 0), (0.1, 0.1, 0.1), 0, count) for k, count in enumerate((20, 100, 900))])
    _, boxes, _, _ = clustered(points, min_points=50, max_points=500, core_points=1)
    assert boxes.point_counts.tolist() == [100]


@pytest.mark.parametrize(
    ("points", "text"), [(np.zeros((0, 3)), "the cloud is empty"), (np.full((5, 3), np.nan), "no finite point")]
)
def test_nothing_to_cluster_is_a_warning(points: np.ndarray, text: str) -> None:
    played = play(Clusterer(), {"cloud": [cloud(points)]})
    (status,), (clusters,) = played["status"], played["clusters"]
    assert text in status.messages[0]
    assert status.levels.tolist() == [1]
    assert clusters.count == 0


def test_points_on_a_line_or_in_one_place_have_a_flat_box() -> None:
    line = np.column_stack([np.linspace(0, 1, 200), np.zeros(200), np.zeros(200)])
    _, boxes, features, _ = clustered(line, core_points=1)
    assert sorted(boxes.sizes[0]) == pytest.approx([0, 0, 1], abs=1e-6)
    np.testing.assert_allclose(features[0], [0, 1, 0, 0], atol=1e-6)
    _, boxes, features, _ = clustered(np.ones((50, 3)), core_points=1)
    assert boxes.sizes.tolist() == [[0, 0, 0]]
    assert features.tolist() == [[0, 0, 0, 0]]


def test_clusterers_repeat_and_a_restored_one_sums_up_alike() -> None:
    assert_repeats(Clusterer, [(cloud(bar((1, 0, 0), (0.5, 0.4, 0.3), 0.2, 800, seed=k), k + 1),) for k in range(2)], 1)


def test_a_turned_bar_gives_the_turn_of_its_box() -> None:
    _, boxes, _, _ = clustered(bar((1, 0, 0), (1.0, 0.2, 0.2), 0.5, 6000))
    x, y = (boxes.orientations[0], quaternion_from_yaw(0.5))
    turn = 2 * np.arccos(min(1.0, abs(float(x @ y))))
    assert min(turn % (np.pi / 2), -turn % (np.pi / 2)) < 0.03


def slab(center: Any, size: Any, rng: np.random.Generator) -> np.ndarray:
    """Points on the faces of an upright box that face the origin, one for each 2 cm², with noise of 3 mm."""
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            if side * (center[axis] + side * size[axis]) < 0:
                own = rng.uniform(-0.5, 0.5, (int(np.prod(np.delete(size, axis)) / 0.0002), 3))
                own[:, axis] = side
                faces.append(own * size)
    return np.concatenate(faces) + center + rng.normal(0, 0.003, (sum(map(len, faces)), 3))


def bookcase(rng: np.random.Generator, x: float = 2.0) -> np.ndarray:
    """Points on the back, the sides and the boards of a bookcase 0.8 m wide that faces the sensor."""
    back = slab((x + 0.3, 0, 0), (0.02, 0.8, 1.2), rng)
    sides = [slab((x + 0.15, y, 0), (0.3, 0.02, 1.2), rng) for y in (-0.4, 0.4)]
    return np.concatenate(
        [back, *sides, *(slab((x + 0.15, 0, z), (0.3, 0.8, 0.02), rng) for z in (-0.6, -0.2, 0.2, 0.6))]
    )


def test_objects_on_shelf_boards_are_separate_clusters() -> None:
    rng = np.random.default_rng(0)
    parts = [
        bookcase(rng),
        slab((2.08, 0.1, -0.11), (0.14, 0.06, 0.16), rng),  # a book that stands on a board
        slab((2.1, -0.2, 0.26), (0.12, 0.12, 0.1), rng),  # a box on the board above
    ]
    points, truth = np.concatenate(parts), np.repeat([0, 1, 2], [len(p) for p in parts])
    clusters, boxes, _, _ = clustered(points)
    for part in range(3):
        overlap = [((clusters.labels == k) & (truth == part)).sum() / ((clusters.labels == k) | (truth == part)).sum()
                   for k in range(clusters.count)]  # fmt: skip
        assert max(overlap) > 0.5
    assert boxes.count == 3
    assert clustered(points, board=float("inf"))[1].count == 1


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3, 4))])
def test_large_things_without_boards_stay_whole(seed: int) -> None:
    rng = np.random.default_rng(seed)
    around = rng.normal(size=(4000, 3))
    body = around / np.linalg.norm(around, axis=1, keepdims=True) * (0.25, 0.15, 0.6) + (2, 0, 0)
    door = slab((2, 2, 0), (0.04, 0.9, 2.0), rng)
    assert clustered(np.concatenate([body, door]))[1].count == 2
