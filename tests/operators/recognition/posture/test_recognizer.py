"""Postures of made people by the shipped network, which people count, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from made_graphs import scene_graph
from numpy.typing import NDArray

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Boxes3D, Classification, Clusters, PointCloud, Pose
from dataflow.testing import play
from operators.recognition import PostureRecognizer
from operators.weights import shipped

SENSOR = (0.0, 0.0, 1.2)
Part = tuple[tuple[float, float, float], tuple[float, float, float]]
"""A box of a body: its middle and full size, metres; the body stands at x = 3 and faces the sensor at x = 0."""

TRUNK: list[Part] = [((3.0, 0.0, 1.15), (0.24, 0.36, 0.6)), ((3.0, 0.0, 1.58), (0.2, 0.16, 0.24))]
ARMS: list[Part] = [((3.0, y, 1.05), (0.1, 0.1, 0.7)) for y in (-0.26, 0.26)]
LEGS: list[Part] = [((3.0, y, 0.44), (0.15, 0.14, 0.88)) for y in (-0.1, 0.1)]
STANDING = [*TRUNK, *ARMS, *LEGS]
STRIDING: list[Part] = [
    *((((x, 0.1, z), size)) for (x, _, z), size in [*TRUNK, *ARMS]),
    ((3.0, 0.0, 1.05), (0.3, 0.2, 0.7)),
    *(
        ((3.0 + s * d, 0.1 * s, z), (0.15, 0.13, 0.3))
        for s in (-1, 1)
        for d, z in ((0.08, 0.75), (0.2, 0.45), (0.32, 0.15))
    ),
]
SITTING: list[Part] = [
    *(((x, y, z - 0.42), size) for (x, y, z), size in [*TRUNK, *ARMS]),
    *(((2.8, y, 0.5), (0.5, 0.15, 0.15)) for y in (-0.11, 0.11)),
    *(((2.55, y, 0.25), (0.13, 0.13, 0.5)) for y in (-0.11, 0.11)),
]


def seen(parts: list[Part], turn: float = 0.0) -> NDArray[np.float64]:
    """Points (P, 3) where rays from the sensor first meet the boxes, turned about the body's own axis."""
    y, z = np.meshgrid(np.arange(-0.32, 0.32, 0.006), np.arange(-0.42, 0.3, 0.006))
    rays = np.stack([np.ones(y.size), y.ravel(), z.ravel()], axis=1)
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    axis = np.array([3.0, 0, 0])
    origin, turned = R.T @ (np.array(SENSOR) - axis) + axis, rays @ R
    nearest = np.full(len(rays), np.inf)
    for middle, size in parts:
        low, high = np.array(middle) - np.array(size) / 2, np.array(middle) + np.array(size) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (low - origin) / turned, (high - origin) / turned
        enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        nearest = np.where((enter < leave) & (enter < nearest), enter, nearest)
    hit = np.isfinite(nearest)
    return np.array(SENSOR) + rays[hit] * nearest[hit, None]


def look(parts: list[Part], *, turn: float = 0.0, stamp: int = 0, last_seen: int | None = None) -> dict[str, Any]:
    """One look at a person in a room with a floor and a back wall, as the operator takes it."""
    own = seen(parts, turn)
    y, z = np.meshgrid(np.arange(-1.5, 1.5, 0.03), np.arange(0.0, 2.5, 0.03))
    room = np.stack([np.full(y.size, 5.0), y.ravel(), z.ravel()], axis=1)
    x, y = np.meshgrid(np.arange(1.5, 5.0, 0.03), np.arange(-1.5, 1.5, 0.03))
    room = np.concatenate([room, np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)])
    top = float(own[:, 2].max())
    place, size = [(3.0, 0.0, top / 2)], [(0.5, 0.5, top)]
    person = (7, "person", place[0], size[0])
    nodes = scene_graph([person], stamp=stamp, frame="map", last_seen=[stamp if last_seen is None else last_seen])
    points = np.concatenate([own, room]) - SENSOR
    return {
        "nodes": nodes,
        "boxes": Boxes3D(
            stamp=stamp, frame="lens", class_names=("person",), centers=np.array(place) - SENSOR, sizes=size,
            orientations=[(0.0, 0.0, 0.0, 1.0)], scores=[0.9], class_ids=[0],
        ),
        "clusters": Clusters(
            stamp=stamp, frame="lens", labels=np.where(np.arange(len(points)) < len(own), 0, -1),
            centroids=own.mean(axis=0)[None] - SENSOR,
        ),
        "cloud": PointCloud(stamp=stamp, frame="lens", points=points.astype(np.float32)),
        "pose": Pose(stamp=stamp, frame="map", child_frame="lens", position=SENSOR, orientation=(0, 0, 0, 1)),
    }  # fmt: skip


def judged(given: dict[str, Any]) -> Classification:
    operator = PostureRecognizer()
    operator.setup()
    return operator.process(**given)


def likeliest(message: Classification) -> str:
    return message.class_names[message.class_ids[0]]


@pytest.mark.parametrize("turn", [0.0, 0.8, np.pi])
def test_standing_and_sitting_bodies_are_not_confused(turn: float) -> None:
    upright = []
    for parts in (STANDING, SITTING):
        message = judged(look(parts, turn=turn))
        assert message.ids.tolist() == [7]
        columns = [message.class_names.index(name) for name in ("standing", "walking")]
        upright.append(float(message.probabilities[0, columns].sum()))
    assert upright[0] > 0.5 > 2 * upright[1]


def test_legs_apart_raise_the_probability_of_walking() -> None:
    walking = [judged(look(parts, turn=np.pi / 2)) for parts in (STANDING, STRIDING)]
    column = walking[0].class_names.index("walking")
    found = [float(m.probabilities[0, column]) for m in walking if m.probabilities is not None]
    assert found[1] > found[0]
    assert likeliest(walking[1]) == "walking"


def test_only_persons_seen_in_this_very_look_are_judged() -> None:
    assert judged(look(STANDING, stamp=1_000_000_000, last_seen=0)).ids.tolist() == []
    other = look(STANDING)
    other["cloud"] = PointCloud(stamp=5, frame="lens", points=other["cloud"].points)
    operator = PostureRecognizer()
    operator.setup()
    assert operator.process(**other).ids.tolist() == []
    assert operator.summary()["graphs without a new view"] == 1


@pytest.mark.parametrize("place", [(3.0, 0.8, 0.9), (np.nan,) * 3], ids=["far from the points", "not finite"])
def test_a_node_that_is_elsewhere_has_no_posture(place: tuple[float, ...]) -> None:
    given = look(STANDING)
    given["nodes"] = given["nodes"].replace(positions=[place])
    assert judged(given).ids.tolist() == []


def test_points_that_are_not_finite_are_left_out() -> None:
    given = look(STANDING)
    points = given["cloud"].points.copy()
    points[::50] = np.nan
    given["cloud"] = given["cloud"].replace(points=points)
    assert judged(given).ids.tolist() == [7]


def test_other_networks_and_other_frames_are_refused() -> None:
    given = {name: [message] for name, message in look(STANDING).items()}
    with pytest.raises(
        OperatorFailure, match="is an activity network; a posture network is needed: `dataflow train posture"
    ):
        play(PostureRecognizer(weights=str(shipped("activity.onnx"))), given)
    elsewhere = Pose.from_matrix(np.eye(4), stamp=0, frame="odom", child_frame="lens")
    with pytest.raises(OperatorFailure, match="the pose is in 'odom', the nodes in 'map'"):
        play(PostureRecognizer(), given | {"pose": [elsewhere]})
