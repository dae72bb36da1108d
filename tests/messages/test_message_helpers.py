"""The small methods of the message types."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow import messages as m
from dataflow.messages.geometry import quaternion_from_yaw, transform_matrix

T = transform_matrix([1.0, 2.0, 3.0], quaternion_from_yaw(0.5))


def test_pose_odometry_and_transforms_keep_their_matrix() -> None:
    pose = m.Pose.from_matrix(T, stamp=1, frame="map", child_frame="base", covariance=np.eye(6).tolist())
    odometry = m.Odometry.from_matrix(
        T, stamp=1, frame="odom", child_frame="base", linear=[1, 0, 0], angular=(0, 0, 1), twist_covariance=np.eye(6)
    )
    tf = m.Transforms.from_matrix(T, stamp=1, frame="map", child_frame="odom")
    for matrix in (pose.matrix(), odometry.matrix(), tf.matrix("odom"), tf.matrices()[0]):
        assert np.allclose(matrix, T, atol=1e-15)
    assert (tf.frames, tf.child_frames, tf.count) == (("map",), ("odom",), 1)
    assert odometry.linear.tolist() == [1, 0, 0]
    assert odometry.pose_covariance is None


def test_an_unknown_child_frame_is_named() -> None:
    tf = m.Transforms.from_matrix(T, stamp=1, frame="map", child_frame="odom")
    with pytest.raises(m.MessageError, match="no child frame 'base'; it has odom"):
        tf.matrix("base")


def test_intrinsics_are_read_back() -> None:
    camera = m.CameraInfo.from_intrinsics(
        stamp=0, frame="c", width=640, height=480, fx=500, fy=501, cx=319.5, cy=239.5,
        distortion_model="plumb_bob", distortion=[0.1, 0, 0, 0, 0],
    )  # fmt: skip
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 501, 319.5, 239.5)
    assert camera.distortion.tolist() == [0.1, 0, 0, 0, 0]


def test_image_dimensions() -> None:
    image = m.Image(stamp=0, frame="c", data=np.zeros((4, 6, 3), np.uint8))
    assert (image.height, image.width, image.is_color) == (4, 6, True)
    assert not image.replace(data=np.zeros((4, 6), np.uint8)).is_color


def test_laser_points_omit_missing_returns() -> None:
    ranges = [2.0, np.inf, np.nan, 0.0, 0.05, 50.0, 3.0]
    scan = m.LaserScan(
        stamp=0, frame="l", angle_min=-np.pi / 2, angle_max=np.pi / 2, range_min=0.1, range_max=30.0, ranges=ranges
    )
    assert scan.angle_increment == pytest.approx(np.pi / 6)
    assert np.allclose(scan.points(), [[0, -2, 0], [0, 3, 0]], atol=1e-12)
    assert scan.replace(ranges=[1.0]).angle_increment == 0.0
    assert scan.replace(ranges=[]).points().shape == (0, 3)


def test_radar_points_use_elevation_where_there_is_one() -> None:
    flat = m.RadarScan(stamp=0, frame="r", ranges=[2, 1], azimuths=[np.pi / 2, 0])
    assert np.allclose(flat.points(), [[0, 2, 0], [1, 0, 0]], atol=1e-6)
    assert np.allclose(flat.replace(elevations=[0, np.pi / 2]).points(), [[0, 2, 0], [0, 0, 1]], atol=1e-6)


def test_labels_name_classes() -> None:
    found = m.Detections2D(
        stamp=0, frame="c", width=9, height=9, class_names=("cat", "dog"),
        boxes=[[0, 0, 1, 1]] * 2, scores=[1, 1], class_ids=[1, 0],
    )  # fmt: skip
    assert found.labels() == ("dog", "cat")
    assert found.replace(class_names=()).labels() == ("1", "0")


def test_detections_without_masks_keep_their_earlier_digest() -> None:
    found = m.Detections2D(
        stamp=1, frame="camera", width=12, height=4, class_names=("cup",), boxes=[[1, 1, 5, 3]], scores=[0.5],
        class_ids=[0],
    )  # fmt: skip
    assert found.digest().hex() == "b9662bf56e2e44e00e460164deb1c120"
    assert found.mask(0) is None
    assert found.replace(masks=np.zeros((1, 4, 2), np.uint8)).digest() != found.digest()


def test_masks_are_unpacked_as_they_were_packed_whatever_the_width() -> None:
    rng = np.random.default_rng(0)
    for width in (7, 8, 9):
        pixels = rng.random((2, 3, width)) < 0.5
        found = m.Detections2D(
            stamp=0, frame="c", width=width, height=3, boxes=[[0, 0, 1, 1]] * 2, scores=[1, 1], class_ids=[0, 0],
            masks=m.pack_masks(pixels),
        )  # fmt: skip
        for k in range(2):
            np.testing.assert_array_equal(found.mask(k), pixels[k])


def test_the_scene_graph_names_its_nodes_and_relations() -> None:
    scene = m.SceneGraph(
        stamp=0, frame="map", class_names=("cup", "table"), predicates=("on",), ids=[10, 20], class_ids=[0, 1],
        positions=np.zeros((2, 3)), sizes=np.ones((2, 3)), subjects=[0], objects=[1],
    )  # fmt: skip
    assert scene.names() == ("cup 10", "table 20")
    assert scene.replace(labels=("my cup", "desk")).names() == ("my cup", "desk")
    assert scene.relations() == ((0, "on", 1),)


def test_the_points_of_a_cluster() -> None:
    clusters = m.Clusters(stamp=0, frame="l", labels=[1, -1, 0, 1], centroids=np.zeros((2, 3)))
    assert [clusters.indices(k).tolist() for k in (0, 1)] == [[2], [0, 3]]


def test_the_pairs_of_a_status() -> None:
    status = m.Diagnostics(
        stamp=0, names=("a", "b"), messages=("", ""), keys=("x", "y", "z"), values=("1", "2", "3"), levels=[0, 1],
        owners=[1, 0, 1],
    )  # fmt: skip
    assert status.pairs(1) == {"x": "1", "z": "3"}
    assert status.replace(owners=None, keys=(), values=()).pairs(0) == {}


def test_the_pose_of_a_grid() -> None:
    grid = m.OccupancyGrid(stamp=0, frame="map", resolution=0.1, cells=np.zeros((1, 1), np.int8), position=[1, 2, 3])
    assert np.array_equal(grid.matrix()[:3, :3], np.eye(3))
    assert np.allclose(grid.replace(orientation=quaternion_from_yaw(0.5)).matrix(), T)


@pytest.mark.parametrize("pitch", [0.0, np.radians(28), -0.3])
def test_a_level_camera_looks_ahead_and_down_by_its_pitch(pitch: float) -> None:
    made = m.Transforms.level_camera(1.2, pitch)
    assert (made.frames, made.child_frames) == (("base_link",), ("camera",))
    R, t = made.matrix("camera")[:3, :3], made.matrix("camera")[:3, 3]
    assert np.allclose(t, [0, 0, 1.2])
    assert np.allclose(R @ R.T, np.eye(3))
    assert np.isclose(np.linalg.det(R), 1)
    assert np.allclose(R @ [1, 0, 0], [0, -1, 0])  # the image's right is the base's right: not rolled
    assert np.allclose(R @ [0, 0, 1], [np.cos(pitch), 0, -np.sin(pitch)])
    ground = R @ (1.2 / np.sin(pitch) * np.array([0, 0, 1])) + t if pitch else np.zeros(3)
    assert np.isclose(ground[2], 0)
