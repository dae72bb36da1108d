"""Calibrations and overlays find their images."""

from __future__ import annotations

from dataflow.messages import CameraInfo, DepthImage, Detections2D, Image, PointCloud, SegmentationMap
from dataflow.view.layout import is_truth, layout


def test_each_image_takes_the_calibration_whose_name_is_nearest() -> None:
    streams = {
        "r/camera/image": Image,
        "r/camera/depth": DepthImage,
        "r/camera/image_info": CameraInfo,
        "r/camera/depth_info": CameraInfo,
        "r/rear/image": Image,
        "r/rear/info": CameraInfo,
    }
    infos = {camera.image: camera.info for camera in layout(streams).cameras}
    assert infos == {
        "r/camera/image": "r/camera/image_info",
        "r/camera/depth": "r/camera/depth_info",
        "r/rear/image": "r/rear/info",
    }


def test_one_calibration_serves_all_images_of_its_device_and_they_share_a_plane() -> None:
    streams = {"r/camera/image": Image, "r/camera/depth": DepthImage, "r/camera/info": CameraInfo}
    shown = layout(streams)
    assert {camera.info for camera in shown.cameras} == {"r/camera/info"}
    assert len({shown.planes[name] for name in streams}) == 1


def test_images_without_calibration_have_separate_planes() -> None:
    shown = layout({"a/image": Image, "b/image": Image})
    assert {camera.info for camera in shown.cameras} == {None}
    assert shown.planes["a/image"] != shown.planes["b/image"]


def test_overlays_go_to_colour_rather_than_depth_and_to_the_likeliest_image() -> None:
    streams = {
        "r/front/image": Image,
        "r/front/depth": DepthImage,
        "r/rear/image": Image,
        "r/rear_detector/boxes": Detections2D,
        "r/front_segmenter/map": SegmentationMap,
        "r/cloud/cloud": PointCloud,
    }
    over = {camera.image: camera.overlays for camera in layout(streams).cameras}
    assert over == {
        "r/front/image": ("r/front_segmenter/map",),
        "r/rear/image": ("r/rear_detector/boxes",),
        "r/front/depth": (),
    }


def test_ground_truth_is_known_by_its_name() -> None:
    assert is_truth("robot1/camera/ground_truth")
    assert is_truth("sim/gt_pose")
    assert not is_truth("robot1/odometry/pose")
