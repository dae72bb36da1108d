"""Files of calibrations: what is written is read again, ROS's are read, wrong ones are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataflow.messages import CameraInfo, Transforms
from operators.geometry.calibration_files import (
    CalibrationFileError,
    camera_text,
    read_camera,
    read_transforms,
    transforms_text,
)

K = np.array([[612.25, 0, 320.5], [0, 611.75, 239.125], [0, 0, 1]])
ROS = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [612.25, 0, 320.5, 0, 611.75, 239.125, 0, 0, 1]
distortion_model: fisheye
distortion_coefficients:
  rows: 1
  cols: 4
  data: [-0.1, 0.02, 0.001, -0.002]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [600, 0, 320, -72, 0, 600, 240, 0, 0, 0, 1, 0]
"""
"""As camera_calibration writes it (other numbers)."""


def info(**other: object) -> CameraInfo:
    known = {"distortion_model": "plumb_bob", "distortion": np.array([-0.2, 0.05, 1e-3, -1e-4, 0.01])}
    return CameraInfo(stamp=0, frame="on", width=640, height=480, K=K, **{**known, **other})


@pytest.mark.parametrize(
    "given",
    [
        info(R=np.eye(3), P=np.column_stack([K, [-70.0, 0, 0]])),
        info(R=np.eye(3), P=np.column_stack([K, np.zeros(3)]), distortion_model="none", distortion=None),
    ],
)
def test_a_camera_that_is_written_is_read_again(given: CameraInfo, tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(camera_text(given, ["a note: with a colon"]))

    assert read_camera(file, "on") == given


def test_a_camera_without_rectification_gets_the_identity_for_ros(tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(camera_text(info()))
    found = read_camera(file, "on")

    assert found.R.tolist() == np.eye(3).tolist()
    assert found.P[:, :3].tolist() == K.tolist()


def test_a_camera_of_ros_is_read(tmp_path: Path) -> None:
    (tmp_path / "ros.yaml").write_text(ROS)
    found = read_camera(tmp_path / "ros.yaml", "camera")

    assert (found.frame, found.distortion_model, found.width) == ("camera", "equidistant", 640)
    assert found.P[0, 3] == -72


def test_transforms_that_are_written_are_read_again_from_several_files(tmp_path: Path) -> None:
    rows = [("imu", "left"), ("left", "1")]
    for k, (frame, child) in enumerate(rows):
        T = np.eye(4)
        T[:3, 3] = k + 0.1, 0.2, -0.3
        one = Transforms.from_matrix(T, stamp=0, frame=frame, child_frame=child)
        (tmp_path / f"{k}.yaml").write_text(transforms_text(one, ["a note"]))
    found = read_transforms([tmp_path / "0.yaml", tmp_path / "1.yaml"])

    assert list(zip(found.frames, found.child_frames, strict=True)) == rows
    assert found.translations.tolist() == [[0.1, 0.2, -0.3], [1.1, 0.2, -0.3]]


@pytest.mark.parametrize(
    ("content", "wrong"),
    [
        ("a: [", "no YAML"),
        ("- a", "holds no calibration: expected a mapping"),
        (ROS.replace("image_width: 640", "image_width: wide"), "a camera: image_width: Input"),
        (ROS.replace("cols: 4\n  data: [-0.1", "cols: 5\n  data: [-0.1"), "a camera: cannot reshape"),
        (ROS.replace("[612.25,", "[-612.25,"), "focal lengths above zero"),
    ],
)
def test_a_wrong_file_of_a_camera_is_named(content: str, wrong: str, tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(content)
    with pytest.raises(CalibrationFileError, match=f"c.yaml .*{wrong}"):
        read_camera(tmp_path / "c.yaml", "camera")


ROW = "  - {frame: a, child_frame: b, translation: [0, 0, 0], rotation: [0, 0, 0, 1]}\n"


@pytest.mark.parametrize(
    ("content", "wrong"),
    [
        ("other: 1", "holds no transforms"),
        ("transforms:\n" + ROW.replace("rotation", "turn"), "a transform is wrong"),
        ("transforms: 5", "holds no transforms: expected `transforms:` with a list"),
        ("transforms:\n" + ROW + ROW, "'b' occurs more than once"),
        (
            "transforms:\n" + ROW + ROW.replace("a,", "b,").replace("child_frame: b", "child_frame: a"),
            "loop|circle|parent",
        ),
        ("transforms:\n" + ROW.replace("0, 1]", "0, 2]"), "unit"),
    ],
)
def test_wrong_transforms_are_named(content: str, wrong: str, tmp_path: Path) -> None:
    (tmp_path / "t.yaml").write_text(content)
    with pytest.raises(CalibrationFileError, match=wrong):
        read_transforms([tmp_path / "t.yaml"])
