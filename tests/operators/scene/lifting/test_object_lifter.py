"""ObjectLifter on a made scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_scene import INFO, Solid, camera, look

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import CameraInfo, PointCloud, Tracks, Transforms, pack_masks
from dataflow.messages.geometry import invert, transform_points
from dataflow.testing import Played, play
from operators.scene import ObjectLifter

CRATE: Solid = ((2.5, 0.4, 0.25), (0.5, 0.4, 0.5), 0.4, 0)
BEHIND: Solid = ((3.6, 0.1, 0.4), (0.5, 0.5, 0.8), 0.0, 0)
MUG: Solid = ((2.45, 0.4, 0.56), (0.09, 0.09, 0.12), 0.0, 1)


def given(*solids: Solid, stamp: int = 1, masks: bool = True, **more: Any) -> dict[str, list[Any]]:
    """What a camera shows of some things, with masks or without; `more` takes the place of some of it."""
    pose = camera(stamp)
    cloud, detections, segmentation = look(pose, solids, noise=0.004)
    streams = {"detections": [detections], "cloud": [cloud], "image_info": [INFO], "pose": [pose]}
    return streams | ({"segmentation": [segmentation]} if masks else {}) | more


def lifted(streams: dict[str, list[Any]], **params: Any) -> Played:
    static = [name for name in ("image_info", "extrinsics") if name in streams]
    return play(ObjectLifter(**params), streams, static=static)


@pytest.mark.parametrize("masks", [True, False], ids=["with masks", "boxes alone"])
def test_a_crate_is_found_where_it_stands(masks: bool) -> None:
    (boxes,) = lifted(given(CRATE, masks=masks))["boxes"]
    center = transform_points(camera(1).matrix(), boxes.centers)[0]
    np.testing.assert_allclose(center, CRATE[0], atol=0.06)
    assert boxes.sizes[0, 2] == pytest.approx(0.5, abs=0.06)
    assert sorted(boxes.sizes[0, :2]) == pytest.approx([0.4, 0.5], abs=0.12)  # masks lose their brinks


@pytest.mark.parametrize("masks", [True, False], ids=["with masks", "boxes alone"])
def test_a_box_that_hides_part_of_another_keeps_its_own_points(masks: bool) -> None:
    streams = given(CRATE, BEHIND, MUG, masks=masks)
    played = lifted(streams)
    (clusters,), (boxes,) = played["clusters"], played["boxes"]
    assert boxes.ids.tolist() == [0, 1, 2]
    world = transform_points(camera(1).matrix(), streams["cloud"][0].points)
    for number, (center, size, _, _) in enumerate((CRATE, BEHIND, MUG)):
        own = world[clusters.labels == number]
        assert len(own) >= 8
        assert (np.abs(own - center) < np.array(size) / 2 + 0.1).all(axis=1).mean() > 0.97


@pytest.mark.parametrize(("stamp", "ids"), [(1, [7, -1, 4]), (2, [-1, -1, -1])], ids=["same image", "another"])
def test_objects_have_the_ids_of_the_tracks_of_their_detections(stamp: int, ids: list[int]) -> None:
    none = np.zeros(3)
    tracks = Tracks(
        stamp=stamp, ids=[4, 7, 9], states=[1, 1, 2], scores=none, class_ids=[1, 0, 0], ages=none, unseen=none,
        boxes=np.zeros((3, 4)), detections=[2, 0, -1],
    )  # fmt: skip
    lifter = ObjectLifter()
    lifter.setup()
    made = lifter.process(**{name: each for name, (each,) in given(CRATE, BEHIND, MUG).items()}, tracks=tracks)
    assert made["boxes"].ids.tolist() == ids
    assert made["images"].ids.tolist() == ids


def test_a_detection_of_nothing_has_no_object_and_is_counted() -> None:
    empty = PointCloud(stamp=1, frame="camera", points=np.full((3, 3), np.nan))
    played = lifted(given(CRATE, masks=False, cloud=[empty]))
    (boxes,), (status,) = played["boxes"], played["status"]
    assert boxes.count == 0
    assert status.levels[0] == 1
    assert status.pairs(0)["without an object"] == "1"


def test_by_the_mask_of_a_detection_a_slatted_back_is_not_what_shows_through_it() -> None:
    slats: list[Solid] = [((2.4, y, 0.45), (0.02, 0.04, 0.5), 0.0, 1) for y in (-0.3, -0.15, 0.0, 0.15, 0.3)]
    streams = given(*slats, ((2.8, 0.0, 0.6), (0.4, 1.2, 1.2), 0.0, 0))
    (detections,), (classes,) = streams["detections"], streams.pop("segmentation")
    own = classes.classes == classes.class_names.index(detections.class_names[1])
    corners = detections.boxes[: len(slats)]
    box = np.concatenate([corners[:, :2].min(axis=0), corners[:, 2:].max(axis=0)])[None]
    back = detections.replace(
        boxes=box, scores=np.ones(1, np.float32), class_ids=np.ones(1, np.int32), ids=None, masks=pack_masks(own[None])
    )
    (boxes,) = lifted(streams | {"detections": [back]})["boxes"]
    assert min(boxes.sizes[0, :2]) < 0.08
    assert transform_points(camera(1).matrix(), boxes.centers)[0] == pytest.approx((2.4, 0, 0.45), abs=0.05)


def test_masks_of_another_time_are_not_used() -> None:
    streams = given(CRATE, stamp=2) | {"segmentation": given(CRATE)["segmentation"]}
    (status,) = lifted(streams)["status"]
    assert status.pairs(0)["masks not used"] == "1"


def test_a_calibration_of_another_image_is_refused() -> None:
    small = CameraInfo.from_intrinsics(stamp=0, frame="camera", width=160, height=120, fx=140, fy=140, cx=80, cy=60)
    with pytest.raises(OperatorFailure, match="320x240 image in 'camera', but image_info describes 160x120"):
        lifted(given(CRATE, image_info=[small]))


def test_a_lidar_beside_the_camera_serves_as_well() -> None:
    T_camera_lidar = np.eye(4)
    T_camera_lidar[:3, 3] = [0.1, -0.05, 0.2]
    streams = given(CRATE, masks=False)
    points = transform_points(invert(T_camera_lidar), streams["cloud"][0].points).astype(np.float32)
    extrinsics = Transforms.from_matrix(T_camera_lidar, stamp=0, frame="camera", child_frame="lidar")
    scan = PointCloud(stamp=1, frame="lidar", points=points)
    (boxes,) = lifted(streams | {"cloud": [scan], "extrinsics": [extrinsics]})["boxes"]
    center = transform_points(camera(1).matrix() @ T_camera_lidar, boxes.centers)[0]
    np.testing.assert_allclose(center, CRATE[0], atol=0.06)


def test_neighbours_whose_boxes_overlap_each_keep_their_points() -> None:
    """Two books side by side: each box reaches over a third of the other book."""
    books: list[Solid] = [((2.4, y, 0.12), (0.16, 0.05, 0.24), 0.0, 0) for y in (0.0, 0.052)]
    streams = given(*books)
    wider = streams["detections"][0].boxes + np.array([-2.0, 0, 2.0, 0], np.float32)
    played = lifted(streams | {"detections": [streams["detections"][0].replace(boxes=wider)]})
    (boxes,), (images,) = played["boxes"], played["images"]
    np.testing.assert_array_equal(images.boxes, wider)
    center = transform_points(camera(1).matrix(), boxes.centers)
    assert abs(center[1, 1] - center[0, 1]) == pytest.approx(0.052, abs=0.015)


def test_a_body_whose_box_is_too_small_is_as_high_as_its_mask() -> None:
    streams = given(((3.0, 0.0, 0.75), (0.4, 0.5, 1.3), 0.0, 0))
    (detections,) = streams["detections"]
    left, upper, right, lower = detections.boxes[0]
    cut = np.array([[left, upper + 0.25 * (lower - upper), right, lower]], np.float32)
    streams["detections"] = [detections.replace(boxes=cut, scores=np.array([0.25], np.float32))]

    def height(streams: dict[str, list[Any]] = streams, **params: Any) -> list[float]:
        return lifted(streams, **params)["boxes"][0].sizes[:, 2].tolist()

    hands = str(Path(__file__).parents[1] / "label_spaces" / "boxes_have_hands.yaml")
    assert height(labels=hands) == pytest.approx([1.3], abs=0.1)
    assert height(labels=hands, min_body_score=0.3) == []
    assert height(min_score=0.2) < [1.15]
    plain = {name: each for name, each in streams.items() if name != "segmentation"}
    assert height(plain, labels=hands) == []  # so weak a box needs a mask that agrees
