"""SurfaceMap on floors, walls and table tops that are seen part by part."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from repeated import assert_repeats

from dataflow.messages import Boxes3D, Clusters, PointCloud, Pose
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
def test_another_plane_side_or_place_is_another_surface(other: SeenSurface) -> None:
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


def surfaces(stamp: int) -> Boxes3D:
    """A floor, a table and something else, as PlaneSegmenter gives them."""
    names, none = ("floor", "wall", "table", "ceiling", "other"), np.tile([0, 0, 0, 1.0], (3, 1))
    return Boxes3D(
        stamp=stamp, frame="camera", class_names=names, centers=[[2.5, 0, -1], [1.6, 1.4, -0.3], [2, 0, 0]],
        sizes=[[3.0, 2.0, 0.02], [1.2, 0.8, 0.02], [9, 9, 0.02]], orientations=none, scores=np.ones(3),
        class_ids=np.array([0, 2, 4], np.int32),
    )  # fmt: skip


def view_of_a_table(stamp: int, given: Boxes3D | None) -> dict[str, Any]:
    """One view without objects of a floor 1 m below the camera and a table top 0.3 m below it."""
    points = np.concatenate([sheet((1, -1, -1), (3, 0, 0), (0, 2, 0)), sheet((1, 1, -0.3), (1.2, 0, 0), (0, 0.8, 0))])
    none = np.zeros((0, 3))
    return {
        "boxes": Boxes3D(
            stamp=stamp, frame="camera", class_names=("mug",), centers=none, sizes=none,
            orientations=np.zeros((0, 4)), scores=np.zeros(0, np.float32), class_ids=np.zeros(0, np.int32),
        ),
        "clusters": Clusters(
            stamp=stamp, frame="camera", labels=np.full(len(points), -1, np.int32), centroids=none
        ),
        "cloud": PointCloud(stamp=stamp, frame="camera", points=points.astype(np.float32)),
        "pose": Pose(stamp=stamp, frame="map", child_frame="camera", position=[0, 0, 1], orientation=[0, 0, 0, 1]),
        "surfaces": given,
    }  # fmt: skip


def test_the_map_has_surfaces_as_nodes_beside_its_objects() -> None:
    known = SemanticMap(labels="simulator")
    known.setup()
    for k in (1, 2):
        nodes = known.process(**view_of_a_table(k * SECOND, surfaces(k * SECOND)))["nodes"]
    named = [nodes.class_names[c] for c in nodes.class_ids]
    assert list(zip(nodes.ids.tolist(), named, strict=True)) == [(0, "floor"), (-12, "tabletop")]
    assert np.allclose(nodes.positions[:, 2], [0, 0.7], atol=0.02)
    assert np.allclose(np.sort(nodes.sizes[1]), [0.02, 0.8, 1.2], atol=0.11)
    assert nodes.last_seen.tolist() == [2 * SECOND] * 2
    later = known.process(**view_of_a_table(3 * SECOND, None))["nodes"]
    assert later.ids.tolist() == nodes.ids.tolist()


def test_surfaces_of_another_time_are_not_used_and_of_another_frame_are_refused() -> None:
    known = SemanticMap(labels="simulator", surface_views=1)
    known.setup()
    assert known.process(**view_of_a_table(2 * SECOND, surfaces(SECOND)))["nodes"].count == 0
    with pytest.raises(ValueError, match="the surfaces are in 'lidar', the cloud in 'camera'"):
        known.process(**view_of_a_table(3 * SECOND, surfaces(3 * SECOND).replace(frame="lidar")))


def test_restored_map_continues_with_its_surfaces() -> None:
    calls = [view_of_a_table(k * SECOND, surfaces(k * SECOND)) for k in range(1, 5)]
    assert_repeats(partial(SemanticMap, labels="simulator"), calls, 3)
