"""CloudColorizer on points whose pixels are known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dataflow.messages import CameraInfo, Image, PointCloud, SegmentationMap, Transforms
from dataflow.testing import Played, play
from operators.cloud import CloudColorizer

INFO = CameraInfo.from_intrinsics(stamp=0, frame="camera", width=40, height=30, fx=20, fy=20, cx=20, cy=15)
# the lidar looks along x, the camera along z, 0.5 m to its left
T = np.array([[0, -1, 0, -0.5], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
MOUNT = Transforms.from_matrix(T, stamp=0, frame="camera", child_frame="lidar")
ROWS, COLUMNS = np.mgrid[:30, :40]
PIXELS = np.stack([ROWS, COLUMNS, np.full_like(ROWS, 7)], axis=-1).astype(np.uint8)


def lidar_points(camera: Any) -> np.ndarray:
    """Points in the lidar's frame from those in the camera's."""
    return (np.asarray(camera, float) - T[:3, 3]) @ T[:3, :3]


def colored(camera: Any, *, classes: np.ndarray | None = None, info: CameraInfo = INFO, **params: Any) -> Played:
    points = lidar_points(camera).astype(np.float32)
    cloud = PointCloud(stamp=1, frame="lidar", points=points, intensities=np.arange(len(points), dtype=np.float32))
    image = Image(stamp=1, frame="camera", data=PIXELS)
    streams: dict[str, Any] = {"cloud": [cloud], "image": [image], "image_info": [info], "extrinsics": [MOUNT]}
    if classes is not None:
        names = ("road", "car", "sky")
        streams["classes"] = [SegmentationMap(stamp=1, frame="camera", class_names=names, void=255, classes=classes)]
    return play(CloudColorizer(**params), streams)


SEEN = [[0, 0, 4], [2, -1, 4], [-1.9, 1.4, 2]]
UNSEEN = [[0, 0, -4], [9, 0, 4], [np.nan, 0, 1]]


def test_a_point_takes_the_colour_of_its_pixel() -> None:
    played = colored([*SEEN, *UNSEEN])
    cloud, status = played["colored"][0], played["status"][0]
    assert cloud.colors.tolist() == [[15, 20, 7], [10, 30, 7], [29, 1, 7], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert status.pairs(0) == {
        "points": "6", "seen": "3", "hidden": "0", "outside the image": "1", "behind or not finite": "2"
    }  # fmt: skip
    assert not played["labels"]


def test_unseen_points_are_left_out_with_their_fields_where_that_is_asked_for() -> None:
    cloud = colored([*UNSEEN, *SEEN], seen_only=True)["colored"][0]
    assert cloud.intensities.tolist() == [3, 4, 5]


def test_occluded_points_are_not_coloured() -> None:
    behind = [[0, 0, 2], [0.1, 0, 6], [0, 0, 2.1]]
    for slack, expected in ((0.1, [True, False, True]), (0.0, [True, True, True])):
        cloud = colored(behind, slack=slack)["colored"][0]
        assert cloud.colors.any(axis=1).tolist() == expected


def test_points_take_the_class_of_their_pixel() -> None:
    classes = np.full((30, 40), 2, np.uint8)
    classes[10, 30], classes[29, 1] = 0, 255
    labels = colored([*SEEN, *UNSEEN], classes=classes)["labels"][0]
    assert labels.ids.tolist() == [0, 2]
    assert labels.labels.tolist() == [1, 0, -1, -1, -1, -1]
    np.testing.assert_allclose(labels.centroids[0], lidar_points([SEEN[1]])[0], atol=1e-6)


def test_an_empty_cloud_is_a_warning() -> None:
    played = colored(np.zeros((0, 3)))
    status = played["status"][0]
    assert (status.messages[0], status.levels[0]) == ("the cloud is empty", 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"info": INFO.replace(width=41)}, "image has 40x30 pixels, but image_info describes 41x30"),
        ({"info": INFO.replace(distortion_model="plumb_bob", distortion=np.ones(5))}, "lens distortion"),
        ({"classes": np.zeros((3, 4), np.uint8)}, r"classes have \(3, 4\) pixels"),
    ],
)
def test_mismatched_input_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(Exception, match=message):
        colored(SEEN, **change)


def test_a_wrong_mount_is_refused() -> None:
    cloud = PointCloud(stamp=1, frame="other", points=np.ones((3, 3), np.float32))
    image = Image(stamp=1, frame="camera", data=PIXELS)
    with pytest.raises(Exception, match="no transform between 'other' and 'camera'"):
        play(CloudColorizer(), {"cloud": [cloud], "image": [image], "image_info": [INFO], "extrinsics": [MOUNT]})
