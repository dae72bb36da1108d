"""SurfaceMap on floors, walls and table tops that are seen part by part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dataflow.messages import Boxes3D, Clusters, PointCloud, Pose, SceneGraph
from dataflow.messages.geometry import matrix_to_quaternion
from operators.scene import SemanticMap
from operators.scene.map.map_surface import MapSurface
from operators.scene.map.range_view import RangeView
from operators.scene.map.surface_map import SeenSurface, SurfaceMap

SECOND = 1_000_000_000
Array = NDArray[np.float64]
NOWHERE = RangeView(np.zeros((0, 3)), np.eye(4), 0.012)


def sheet(corner: Sequence[float], along: Sequence[float], up: Sequence[float], step: float = 0.05) -> Array:
    """Points every 5 cm on a rectangle."""
    a, b = np.array(along, float), np.array(up, float)
    s = np.arange(step / 2, np.linalg.norm(a), step) / np.linalg.norm(a)
    t = np.arange(step / 2, np.linalg.norm(b), step) / np.linalg.norm(b)
    return np.asarray(np.array(corner) + (s[:, None, None] * a + t[None, :, None] * b).reshape(-1, 3))


def floor(x: float, width: float, height: float = 0.0) -> SeenSurface:
    return SeenSurface("floor", np.array([0.0, 0, 1]), sheet((x, 0, height), (width, 0, 0), (0, 3, 0)))


def wall(x: float, length: float, y: float = 4.0, side: float = -1.0) -> SeenSurface:
    return SeenSurface("wall", np.array([0.0, side, 0]), sheet((x, y, 0), (length, 0, 0), (0, 0, 2.4)))


def top(x: float, y: float = 0.0, height: float = 0.75) -> SeenSurface:
    return SeenSurface("tabletop", np.array([0.0, 0, 1]), sheet((x, y, height), (1.2, 0, 0), (0, 0.8, 0)))


def mapped(views: Sequence[Sequence[SeenSurface]], view: RangeView = NOWHERE, **params: Any) -> SurfaceMap:
    known = SurfaceMap(**params)
    for k, seen in enumerate(views):
        known.update((k + 1) * SECOND, seen, view)
    return known


def labels(known: SurfaceMap) -> list[str]:
    return sorted(s.label for s in known.confirmed)


def only(known: SurfaceMap) -> MapSurface:
    (surface,) = known.confirmed
    return surface


@settings(max_examples=40, deadline=None)
@given(st.permutations(range(6)), st.floats(0.8, 1.5), st.floats(-3.1, 3.1))
def test_a_wall_seen_part_by_part_is_one_in_whatever_order(order: list[int], width: float, turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    parts = [wall(0.5 * k, width) for k in order]
    surface = only(mapped([[SeenSurface(p.label, R @ p.facing, p.points @ R.T)] for p in parts]))
    center, size, yaw = surface.box
    assert np.allclose(center, R @ [(2.5 + width) / 2, 4.0, 1.2], atol=0.08)
    assert np.allclose(size, [2.5 + width, 0.02, 2.4], atol=0.2)
    assert abs(np.sin(yaw - turn)) < 0.01


def test_there_is_one_floor_and_its_height_is_that_of_most_of_it() -> None:
    surface = only(mapped([[floor(0, 2)], [floor(5, 2, 0.01)], [floor(0, 2, -0.01)]]))
    assert surface.label == "floor"
    assert np.allclose(np.sort(surface.size), [0.02, 3, 7], atol=0.15)
    assert abs(surface.center[2] + 0.01) < 0.015


@pytest.mark.parametrize(
    "other",
    [
        wall(0, 2, y=4.3),  # behind it
        wall(0, 2, y=4.05, side=1.0),  # its other side
        wall(3, 2),  # in its plane, beyond a wide opening
        top(0, 3.2),  # at it
    ],
)
def test_what_has_another_plane_side_or_place_is_another_surface(other: SeenSurface) -> None:
    assert len(mapped([[wall(0, 2), other]] * 3).confirmed) == 2


def test_two_parts_that_a_third_joins_become_one_with_the_older_id() -> None:
    known = mapped([[wall(0, 1.5), wall(3, 1.5)]] * 2 + [[wall(0.5, 3.5)]])
    assert only(known).id == 1
    assert only(known).size[0] > 4


def test_a_plane_seen_once_is_not_yet_a_surface_and_is_forgotten() -> None:
    known = mapped([[wall(0, 2)], [floor(0, 2)]])
    assert known.confirmed == []
    for k in range(30):
        known.update((k + 3) * SECOND, [floor(0, 2)], NOWHERE)
    assert labels(known) == ["floor"]
    assert len(known.surfaces) == 1


def test_a_table_top_that_a_view_looks_through_goes_and_one_out_of_sight_stays() -> None:
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    T[:3, 3] = (-2, 0.4, 1.5)
    behind = sheet((-0.5, -3, 0), (6, 0, 0), (0, 7, 0), step=0.03)
    view = RangeView((behind - T[:3, 3]) @ T[:3, :3], T, 0.03)
    known = mapped([[top(0), top(0, 30.0)]] * 3)
    assert labels(known) == ["tabletop", "tabletop"]
    for k in range(4):
        known.update((k + 9) * SECOND, [], view)
    assert [s.center[1] > 20 for s in known.confirmed] == [True]


def surfaces(stamp: int, parts: Sequence[tuple[str, Array, tuple[float, float]]]) -> Boxes3D:
    """Boxes as PlaneSegmenter gives them: the class, T_cloud_rectangle (4, 4), and the size on the plane."""
    names = ("floor", "wall", "table", "ceiling", "other")
    T = np.array([T for _, T, _ in parts]).reshape(-1, 4, 4)
    return Boxes3D(
        stamp=stamp,
        frame="camera",
        class_names=names,
        centers=T[:, :3, 3],
        sizes=np.array([[*size, 0.02] for _, _, size in parts]).reshape(-1, 3),
        orientations=matrix_to_quaternion(T),
        scores=np.ones(len(parts), np.float32),
        class_ids=np.array([names.index(name) for name, _, _ in parts], np.int32),
    )


def step(known: SemanticMap, stamp: int, given: Boxes3D | None) -> SceneGraph:
    """One view without objects of a floor 1 m below the camera and a table top 0.3 m below it."""
    points = np.concatenate([sheet((1, -1, -1), (3, 0, 0), (0, 2, 0)), sheet((1, 1, -0.3), (1.2, 0, 0), (0, 0.8, 0))])
    cloud = PointCloud(stamp=stamp, frame="camera", points=points.astype(np.float32))
    none = np.zeros((0, 3))
    boxes = Boxes3D(
        stamp=stamp,
        frame="camera",
        class_names=("mug",),
        centers=none,
        sizes=none,
        orientations=np.zeros((0, 4)),
        scores=np.zeros(0, np.float32),
        class_ids=np.zeros(0, np.int32),
    )
    labels = np.full(len(points), -1, np.int32)
    clusters = Clusters(stamp=stamp, frame="camera", labels=labels, centroids=none)
    pose = Pose(stamp=stamp, frame="map", child_frame="camera", position=[0, 0, 1], orientation=[0, 0, 0, 1])
    return known.process(boxes, clusters, cloud, pose, surfaces=given)["nodes"]


def at(x: float, y: float, z: float) -> Array:
    T = np.eye(4)
    T[:3, 3] = (x, y, z)
    return T


PARTS = [
    ("floor", at(2.5, 0, -1), (3.0, 2.0)),
    ("table", at(1.6, 1.4, -0.3), (1.2, 0.8)),
    ("other", at(2, 0, 0), (9.0, 9.0)),
]


def test_the_map_has_surfaces_as_nodes_beside_its_objects() -> None:
    known = SemanticMap(labels="simulator")
    known.setup()
    for k in range(2):
        nodes = step(known, (k + 1) * SECOND, surfaces((k + 1) * SECOND, PARTS))
    named = [nodes.class_names[c] for c in nodes.class_ids]
    assert list(zip(nodes.ids.tolist(), named, strict=True)) == [(0, "floor"), (-12, "tabletop")]
    assert np.allclose(nodes.positions[:, 2], [0, 0.7], atol=0.02)
    assert np.allclose(np.sort(nodes.sizes[1]), [0.02, 0.8, 1.2], atol=0.11)
    assert nodes.last_seen.tolist() == [2 * SECOND] * 2
    later = step(known, 3 * SECOND, None)
    assert later.ids.tolist() == nodes.ids.tolist()


def test_surfaces_of_another_time_are_not_used_and_of_another_frame_are_refused() -> None:
    known = SemanticMap(labels="simulator", surface_views=1)
    known.setup()
    assert step(known, 2 * SECOND, surfaces(SECOND, PARTS)).count == 0
    with pytest.raises(ValueError, match="the surfaces are in 'lidar', the cloud in 'camera'"):
        step(known, 3 * SECOND, surfaces(3 * SECOND, PARTS).replace(frame="lidar"))


def test_a_restored_map_goes_on_with_its_surfaces() -> None:
    first, other = SemanticMap(labels="simulator"), SemanticMap(labels="simulator")
    for each in (first, other):
        each.setup()
    for k in range(3):
        step(first, (k + 1) * SECOND, surfaces((k + 1) * SECOND, PARTS))
    other.restore(first.snapshot())
    a, b = (step(each, 4 * SECOND, surfaces(4 * SECOND, PARTS)) for each in (first, other))
    assert a.digest() == b.digest()
    assert a.count == 2
