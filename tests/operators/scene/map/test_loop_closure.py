"""SemanticMap on a made round with drift whose truth is known: what corrected keyframes move, and how far."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from made_scene import INFO, Solid, camera, look
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Boxes3D, Message, Path, Pose
from dataflow.messages.geometry import matrix_to_quaternion, yaw_of
from dataflow.testing import Played, play
from operators.scene import ObjectLifter, SemanticMap
from operators.scene.bodies import upright_iou

Array = np.ndarray[Any, np.dtype[np.float64]]
pytestmark = pytest.mark.long

STEP = 200_000_000  # ns
VIEWS, LOOP = 84, 80
"""Views of a round and a bit more, and the one at which SLAM closes the loop."""
ROUND = 72  # views of a whole round


def solid(k: int) -> Solid:
    """One of 11 boxes on a circle of 5.2 m, all of other sizes and headings."""
    at, size = 2 * np.pi * (k + 0.5) / 11, (0.4 + 0.03 * k, 0.6 - 0.02 * k, 0.5 + 0.04 * k)
    return (5.2 * np.cos(at), 5.2 * np.sin(at), size[2] / 2), size, at + 0.3, 0


SOLIDS = [solid(k) for k in range(11)]


def motion(x: float, y: float, yaw: float) -> Array:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = x, y
    return T


def drift(k: int) -> Array:
    """By what odometry is off at a view: 0.7 m aside and 4° at the end of the round."""
    return motion(0.6 * k / ROUND, -0.4 * k / ROUND, np.radians(4.0) * k / ROUND)


def true_pose(k: int) -> Pose:
    """A robot on a circle of 3 m that looks outward."""
    at = 2 * np.pi * k / ROUND
    return camera((k + 1) * STEP, (3 * np.cos(at), 3 * np.sin(at), 1.0), at)


def moved(pose: Pose, T: Array) -> Pose:
    M = T @ pose.matrix()
    return Pose(
        stamp=pose.stamp, frame=pose.frame, child_frame=pose.child_frame, position=M[:3, 3],
        orientation=matrix_to_quaternion(M[:3, :3]),
    )  # fmt: skip


@cache
def seen(closed: bool) -> dict[str, list[Any]]:
    """What the map is given; with `closed`, poses from the loop on are right."""
    lifter = ObjectLifter()
    lifter.setup()
    streams: dict[str, list[Any]] = {name: [] for name in ("boxes", "clusters", "cloud", "pose", "images")}
    for k in range(VIEWS):
        true = true_pose(k)
        cloud, detections, masks = look(true, SOLIDS, wall=1e9, noise=0.004)
        given = true if closed and k >= LOOP else moved(true, drift(k))
        found = lifter.process(detections, cloud, INFO, segmentation=masks, pose=given)
        for name, message in (*found.items(), ("cloud", cloud), ("pose", given)):
            if name in streams:
                streams[name].append(message)
    return streams | {"image_info": [INFO]}


def keyframes(stamp: int, **more: Any) -> Path:
    """Every fifth pose as SLAM has it after the loop: where it was in truth."""
    poses = [true_pose(k) for k in range(0, LOOP + 1, 5)]
    return Path(
        stamp=stamp,
        **{"frame": "world", "stamps": [p.stamp for p in poses]} | more,
        positions=np.array([p.position for p in poses]),
        orientations=np.array([p.orientation for p in poses]),
    )


def mapped(*corrections: Path) -> Played:
    given: dict[str, list[Message]] = dict(seen(bool(corrections)))
    return play(SemanticMap(), given | ({"keyframes": list(corrections)} if corrections else {}))


def objects(played: Played, index: int = -1) -> Boxes3D:
    return played["objects"][index]


def errors(message: Boxes3D) -> Array:
    """How far each object of the map is from the nearest true one on the ground, metres."""
    true = np.array([s[0][:2] for s in SOLIDS])
    return np.asarray(np.linalg.norm(message.centers[:, None, :2] - true[None], axis=2).min(axis=1))


def overlaps(message: Boxes3D) -> list[float]:
    """The IoU of each true object with the best of the map."""
    mine = list(zip(message.centers, message.sizes, yaw_of(message.orientations).tolist(), strict=True))
    true = [(np.array(center), np.array(size), yaw) for center, size, yaw, _ in SOLIDS]
    return [max(upright_iou(box, each) for box in mine) for each in true]


def test_objects_are_where_they_are_once_a_loop_is_closed() -> None:
    drifted, closed = objects(mapped()), objects(mapped(keyframes((LOOP + 1) * STEP)))
    assert errors(drifted).max() > 0.35
    assert errors(closed).max() < 0.05
    assert drifted.count > len(SOLIDS)  # what was seen again is there twice
    assert closed.count == len(SOLIDS)


def test_ids_outlast_the_correction_and_boxes_lie_on_the_true_ones() -> None:
    played = mapped(keyframes((LOOP + 1) * STEP))
    before, after = objects(played, LOOP - 1), objects(played)
    assert set(after.ids.tolist()) <= set(before.ids.tolist())
    assert min(overlaps(after)) > 0.55
    assert max(overlaps(before)[-3:]) < 0.3


def test_unchanged_keyframes_move_nothing() -> None:
    again = keyframes((LOOP + 2) * STEP)
    once, twice = mapped(keyframes((LOOP + 1) * STEP)), mapped(keyframes((LOOP + 1) * STEP), again)
    np.testing.assert_allclose(objects(twice).centers, objects(once).centers, atol=0.03)


def test_the_map_is_the_same_every_time_and_goes_on_from_a_snapshot() -> None:
    rows, path = seen(True), keyframes((LOOP + 1) * STEP)
    calls = [
        {name: rows[name][k] for name in rows if name != "image_info"} | {"image_info": INFO} for k in range(VIEWS)
    ]
    assert_repeats(
        SemanticMap, [call | {"keyframes": path if k >= LOOP else None} for k, call in enumerate(calls)], LOOP - 2
    )


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"stamps": None}, "the keyframes have no stamps: a map moves with keyframes of which both are known"),
        ({"frame": "odom"}, "the keyframes are in 'odom', the map in 'world'"),
    ],
)
def test_keyframes_that_tell_nothing_of_this_map_are_refused(more: dict[str, Any], words: str) -> None:
    with pytest.raises(OperatorFailure, match=words):
        mapped(keyframes((LOOP + 1) * STEP, **more))
