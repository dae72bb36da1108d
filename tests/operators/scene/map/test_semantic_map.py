"""SemanticMap on a made scene that the camera looks at from several sides."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_scene import INFO, Solid, camera, look
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Boxes3D, Clusters, PointCloud, Pose
from dataflow.messages.geometry import yaw_of
from dataflow.testing import Played, play
from operators.labels import SizePrior
from operators.scene import ObjectLifter, SemanticMap
from operators.scene.bodies import upright_iou
from operators.scene.map.map_object import completed

SECOND = 1_000_000_000
CRATE: Solid = ((2.5, 0.5, 0.25), (0.5, 0.4, 0.5), 0.3, 0)
OTHER: Solid = ((2.8, -0.8, 0.2), (0.4, 0.4, 0.4), 0.0, 0)
AROUND = [((0.3 * np.sin(k), 0.9 * np.sin(0.7 * k), 1.0), 0.15 * np.sin(k)) for k in range(12)]

BOOK = SizePrior((0.04, 0.17, 0.22), (0.3, 0.1, 0.1))

MUGS_MOVE = str(Path(__file__).parents[1] / "label_spaces" / "mugs_move.yaml")


def views(scenes: Sequence[Sequence[Solid]], *, images: bool = False) -> list[tuple[Any, ...]]:
    """What the lifter gives for each scene, a fifth of a second apart, from changing places: as `process` takes it."""
    lifter = ObjectLifter()
    lifter.setup()
    made: list[tuple[Any, ...]] = []
    for k, solids in enumerate(scenes):
        position, yaw = AROUND[k % len(AROUND)]
        pose = camera((k + 1) * SECOND // 5, position, yaw)
        cloud, detections, masks = look(pose, solids, noise=0.004)
        found = lifter.process(detections, cloud, INFO, segmentation=masks, pose=pose)
        made.append(
            (found["boxes"], found["clusters"], cloud, pose, *((None, found["images"], INFO) if images else ()))
        )
    return made


def mapped(given: Sequence[tuple[Any, ...]], **params: Any) -> Played:
    names = ("boxes", "clusters", "cloud", "pose")
    streams = {name: [view[k] for view in given] for k, name in enumerate(names)}
    return play(SemanticMap(labels=MUGS_MOVE, **params), streams)


def last(played: Played, index: int = -1) -> Boxes3D:
    return played["objects"][index]


def ids(message: Boxes3D) -> list[int]:
    return message.ids.tolist()


def best_iou(message: Boxes3D, solid: Solid) -> float:
    yaws = yaw_of(message.orientations)
    mine = [(message.centers[k], message.sizes[k], float(yaws[k])) for k in range(message.count)]
    return max(upright_iou(box, (np.array(solid[0]), np.array(solid[1]), solid[2])) for box in mine)


def test_objects_are_mapped_once_with_their_boxes() -> None:
    played = mapped(views([[CRATE, OTHER]] * 10))
    message = last(played)
    assert ids(message) == [1, 2]
    assert best_iou(message, CRATE) > 0.6
    assert best_iou(message, OTHER) > 0.6
    assert (message.scores > 0.95).all()
    nodes = played["nodes"][-1]
    assert nodes.last_seen.tolist() == [2 * SECOND, 2 * SECOND]


def test_a_moved_object_is_moved_and_not_doubled() -> None:
    there: Solid = ((3.0, 0.1, 0.25), CRATE[1], 0.3, 0)
    played = mapped(views([[CRATE, OTHER]] * 6 + [[there, OTHER]] * 12))
    message = last(played)
    assert sorted(ids(message)) == [1, 2]
    assert best_iou(message, there) > 0.5
    assert best_iou(message, CRATE) < 0.05


def test_removed_objects_go_and_occluded_ones_stay() -> None:
    screen: Solid = ((1.7, 0.5, 0.6), (0.1, 1.2, 1.2), 0.0, 0)
    assert ids(last(mapped(views([[CRATE, OTHER]] * 6 + [[OTHER]] * 8)))) == [2]
    hidden = views([[CRATE, OTHER]] * 6 + [[CRATE, OTHER, screen]] * 8)
    assert {1, 2} <= set(ids(last(mapped(hidden))))


def test_one_false_detection_is_no_object() -> None:
    false: Solid = ((3.2, 0.9, 0.3), (0.3, 0.3, 0.3), 0.0, 0)
    played = mapped(views([[CRATE]] * 3 + [[CRATE, false]] + [[CRATE]] * 6))
    assert all(len(ids(last(played, k))) <= 1 for k in range(10))


def test_a_mover_keeps_its_id_and_has_a_velocity() -> None:
    moving = [[((2.0 + 0.1 * k, 0.2, 0.3), (0.25, 0.25, 0.6), 0.0, 1)] for k in range(10)]
    message = last(mapped(views(moving)))
    assert ids(message) == [1]
    np.testing.assert_allclose(message.velocities[0, :2], [0.5, 0.0], atol=0.15)


def test_streams_that_do_not_belong_together_are_refused() -> None:
    (first, second) = views([[CRATE, OTHER], [CRATE]])
    operator = SemanticMap()
    operator.setup()
    with pytest.raises(ValueError, match="2 boxes, 1 clusters and labels"):
        operator.process(first[0], second[1], first[2], first[3])
    elsewhere = Pose(stamp=2 * SECOND, frame="odom", child_frame="camera", position=[0, 0, 1], orientation=[0, 0, 0, 1])
    with pytest.raises(OperatorFailure, match="the pose is in 'odom', the map in 'world'"):
        mapped([first, (*second[:3], elsewhere.replace(stamp=second[2].stamp))])


def test_a_view_without_points_is_survived() -> None:
    given = views([[CRATE]] * 5)
    stamp, none = given[-1][2].stamp + SECOND, np.zeros((0, 3))
    boxes = Boxes3D(
        stamp=stamp, frame="camera", class_names=given[0][0].class_names, centers=none, sizes=none,
        orientations=np.zeros((0, 4)), scores=np.zeros(0, np.float32), class_ids=np.zeros(0, np.int32),
    )  # fmt: skip
    clusters = Clusters(stamp=stamp, frame="camera", labels=np.zeros(0, np.int32), centroids=none)
    given.append((boxes, clusters, PointCloud(stamp=stamp, frame="camera", points=none), camera(stamp)))
    assert ids(last(mapped(given))) == [1]


def test_restored_semantic_map_continues_identically() -> None:
    assert_repeats(partial(SemanticMap, labels=MUGS_MOVE), views([[CRATE, OTHER]] * 8), 4)


def test_box_is_completed_away_from_the_viewer_by_the_usual_size() -> None:
    """The spine of a book in a shelf, seen along x: 4 cm wide, no depth."""
    seen = (np.array([2.0, 0, 1]), np.array([0.0, 0.04, 0.22]), 0.0)
    center, size, _ = completed(seen, np.array([1.0, 0.0]), BOOK)
    np.testing.assert_allclose(size, [0.17, 0.04, 0.22])
    np.testing.assert_allclose(center, [2.085, 0, 1])
    center, size, _ = completed(seen, np.array([0.0, 0.0]), BOOK)
    np.testing.assert_allclose(size, seen[1])


def test_image_boxes_separate_neighbours_also_after_restoring() -> None:
    """Two crates that nearly touch, seen from the front: voxels alone cannot tell where one ends."""
    pair: list[Solid] = [((2.5, y, 0.15), (0.3, 0.2, 0.3), 0.0, 0) for y in (0.0, 0.22)]
    given = views([pair] * 10, images=True)
    assert_repeats(SemanticMap, given, 5)
    operator = SemanticMap()
    operator.setup()
    message = [operator.process(*view)["objects"] for view in given][-1]
    assert len(ids(message)) == 2
    assert min(best_iou(message, solid) for solid in pair) > 0.5


def test_boxes_in_the_image_bear_the_ids_of_their_nodes() -> None:
    operator = SemanticMap(labels=MUGS_MOVE)
    operator.setup()
    given = views([[CRATE, OTHER]] * 10, images=True)
    made = [operator.process(*view) for view in given]
    assert made[0]["seen"].count == 0, "nothing is sure yet"
    seen, nodes = made[-1]["seen"], made[-1]["nodes"]
    assert sorted(seen.ids.tolist()) == sorted(nodes.ids.tolist())
    places = dict(zip(nodes.ids.tolist(), nodes.positions[:, 1].tolist(), strict=True))
    from_left = [seen.ids.tolist()[k] for k in np.argsort(seen.boxes[:, 0])]
    assert from_left == sorted(places, key=lambda id: -places[id]), "y points to the left"
    assert {tuple(box) for box in seen.boxes.tolist()} == {tuple(box) for box in given[-1][5].boxes.tolist()}
    boxes, clusters, cloud, pose, *_ = given[-1]
    assert "seen" not in operator.process(boxes, clusters, cloud.replace(stamp=cloud.stamp + 1), pose)


def test_classes_may_be_added_and_not_be_exchanged() -> None:
    given = views([[CRATE, OTHER]] * 6)
    wider = [(b.replace(class_names=(*b.class_names, "lamp")), *rest) for b, *rest in given[3:]]
    lamps = [(b.replace(class_ids=np.full(b.count, len(b.class_names) - 1, np.int32)), *rest) for b, *rest in wider]
    plain, grown, renamed = (mapped([*given[:3], *more]) for more in (given[3:], wider, lamps))
    assert last(grown).class_names == (*given[0][0].class_names, "lamp")
    assert last(grown).replace(class_names=last(plain).class_names).digest() == last(plain).digest()
    assert ids(last(renamed)) == ids(last(plain)), "votes for a new class join those for old ones"
    with pytest.raises(OperatorFailure, match="boxes have the classes"):
        mapped([given[0], (given[1][0].replace(class_names=("lamp", "mug")), *given[1][1:])])


def test_images_of_another_camera_are_refused() -> None:
    (view,) = views([[CRATE]], images=True)
    operator = SemanticMap()
    operator.setup()
    with pytest.raises(ValueError, match="images are of 320x240 pixels in 'camera', but image_info describes 320x240"):
        operator.process(*view[:6], INFO.replace(frame="other"))
