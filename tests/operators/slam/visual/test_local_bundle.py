"""Map points of views of a made room, and the keyframes that are adjusted by them; the truth is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from dataflow.execution.snapshots import pack_state, unpack_state
from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.geometry.se3 import Matrix
from operators.odometry.rgbd.camera import RgbdCamera
from operators.odometry.rgbd.fitting import Fitter
from operators.odometry.rgbd.noise import Noise
from operators.odometry.rgbd.settings import RgbdOdometryConfig
from operators.odometry.rgbd.tracker import RgbdOdometry
from operators.slam.keyframe_graph import KeyframeGraph, Node
from operators.slam.visual.bundle import adjust_newest
from operators.slam.visual.map_points import LONE, MapPoints
from operators.slam.visual.view import View
from operators.sources.room import Room, camera_path

K = np.array([[158.0, 0.0, 95.5], [0.0, 158.0, 71.5], [0.0, 0.0, 1.0]])
CAMERA = RgbdCamera(K, K)
FITTER = Fitter(CAMERA, RgbdOdometryConfig(), Noise(0.3, 1.0))
PATH = [camera_path(0.7 * k, 36.0) for k in range(6)]


@cache
def view(k: int) -> View:
    seen = Room(0).render(PATH[k], K, (192, 144))
    odometry = RgbdOdometry(CAMERA)
    depth = seen.depth + 0.0015 * seen.depth**2 * np.random.default_rng(k).standard_normal(seen.depth.shape)
    odometry.track(seen.image, depth.astype(np.float32), 0)
    return View.of(odometry.state.map.newest, CAMERA)


def node(k: int, T: Matrix) -> Node[View]:
    return Node(k, T, np.eye(6), T, np.eye(6), float(k), 0, view(k))


def graph_of(poses: list[Matrix]) -> tuple[KeyframeGraph[View], MapPoints]:
    """A graph of views at poses, the first fixed, tied to each other by motions that are hardly known; its points."""
    graph, points = KeyframeGraph[View](), MapPoints()
    for k, T in enumerate(poses):
        number = graph.add(node(k, T))
        if k:
            graph.join(k - 1, number, invert(poses[k - 1]) @ T, 0.01 * np.eye(6), loop=False)
        points.see(number, view(k), graph.nodes, list(range(k)), CAMERA)
    return graph, points


def shaken(seed: int) -> list[Matrix]:
    """The path, the newest three poses off by 2 cm and 7 mrad."""
    rng = np.random.default_rng(seed)
    off = [se3.exp(rng.choice([-1, 1], 6) * np.array([0.012] * 3 + [0.004] * 3)) for _ in range(3)]
    return [*PATH[:3], *(T @ d for T, d in zip(PATH[3:], off, strict=True))]


def errors(graph: KeyframeGraph[View]) -> NDArray[np.float64]:
    return np.array([np.linalg.norm(graph.nodes[k].T[:3, 3] - T[:3, 3]) for k, T in enumerate(PATH)])


@pytest.mark.long
def test_points_are_seen_where_they_are() -> None:
    graph, points = graph_of(PATH)
    rows = points.shared(np.arange(6), 3, 1000)
    assert len(rows) > 40
    world = points.world(rows, graph.nodes)
    for k, T in enumerate(PATH):
        seen = points.sightings[points.sightings.nodes == k]
        shown = np.isin(rows, seen.points)
        camera = transform_points(invert(T), world[shown])
        order = np.argsort(seen.points)
        pixels = seen.pixels[order][np.isin(seen.points[order], rows)]
        assert np.median(np.linalg.norm(project(camera, K) - pixels, axis=1)) < 1.0


def test_points_move_with_the_node_that_saw_them_first() -> None:
    graph, points = graph_of(PATH[:2])
    rows = np.flatnonzero(points.anchors == 1)
    before = points.world(rows, graph.nodes)
    T = se3.exp(np.array([0.3, -0.1, 0.2, 0.1, 0.2, -0.3]))
    graph.nodes[1].T = T @ graph.nodes[1].T
    np.testing.assert_allclose(points.world(rows, graph.nodes), transform_points(T, before), atol=1e-9)
    points.move(rows, before, graph.nodes)
    np.testing.assert_allclose(points.world(rows, graph.nodes), before, atol=1e-9)


def test_nodes_without_a_view_add_sightings_and_no_points() -> None:
    graph, points = graph_of(PATH[:3])
    count = len(points.anchors)
    number = graph.add(node(3, PATH[3]))
    graph.nodes[number].view = None
    points.see(number, view(3), graph.nodes, [0, 1, 2], CAMERA)
    assert len(points.anchors) == count
    assert np.count_nonzero(points.sightings.nodes == number) > 20


def test_sightings_of_removed_nodes_and_old_lone_points_are_forgotten() -> None:
    graph, points = graph_of(PATH[:3])
    gone = graph.add(node(3, PATH[3]))
    graph.nodes[gone].view = None
    points.see(gone, view(3), graph.nodes, [0, 1, 2], CAMERA)
    assert (points.sightings.nodes == gone).any()
    del graph.nodes[gone]
    late = 2 + LONE + 1
    graph.nodes[late] = node(5, PATH[5])
    points.see(late, view(5), graph.nodes, [], CAMERA)
    assert not (points.sightings.nodes == gone).any()
    counts = np.bincount(points.sightings.points, minlength=len(points.anchors))
    old = points.anchors < late
    assert np.count_nonzero(old) > 40
    assert counts[old].min() == 2
    assert (counts[~old] == 1).all()


def test_a_local_adjustment_takes_errors_of_the_newest_keyframes_away() -> None:
    for seed in range(3):
        graph, points = graph_of(shaken(seed))
        before = errors(graph)
        adjust_newest(graph, points, FITTER, 3)
        after = errors(graph)
        assert before.max() > 0.015
        assert after.max() < 0.4 * before.max()
        assert all(graph.nodes[k].T.tobytes() == PATH[k].tobytes() for k in range(3))


def test_sightings_of_something_else_are_forgotten() -> None:
    graph, points = graph_of(PATH)
    rows = points.shared(np.arange(6), 3, 1000)
    wrong = np.flatnonzero(np.isin(points.sightings.points, rows) & (points.sightings.nodes == 5))[:4]
    assert len(wrong) == 4
    points.sightings.pixels[wrong] += 30.0
    moved = points.sightings.pixels[wrong].copy()
    adjust_newest(graph, points, FITTER, 3)
    kept = points.sightings.pixels[points.sightings.nodes == 5]
    assert not any((kept == pixel).all(axis=1).any() for pixel in moved)
    assert errors(graph).max() < 0.01


def test_points_go_on_alike_from_plain_values() -> None:
    graph, points = graph_of(PATH)
    again = MapPoints()
    again.restore(unpack_state(pack_state(points.snapshot())))
    adjust_newest(graph, points, FITTER, 3)
    other, _ = graph_of(PATH)
    adjust_newest(other, again, FITTER, 3)
    assert pack_state(points.snapshot()) == pack_state(again.snapshot())
    assert all(graph.nodes[k].T.tobytes() == other.nodes[k].T.tobytes() for k in graph.nodes)
