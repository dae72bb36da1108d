"""KittiRaw on made folders of both layouts, and on a real drive."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dataflow.messages import CameraInfo, Image, PointCloud, Transforms
from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import KittiRaw

R_VELO = "0 -1 0 0 0 -1 1 0 0"
IMAGE = np.full((4, 6, 3), (10, 20, 200), np.uint8)  # RGB
POINTS = np.array([[1, 2, 3, 0.5], [4, 5, 6, 0.25]], np.float32)


def calibration(offset: float = 0.0, **changes: str) -> str:
    lines = {
        "P_rect_02": f"100 0 3 {offset} 0 100 2 0 0 0 1 0", "R_rect_00": "1 0 0 0 1 0 0 0 1", "R_velo_to_cam": R_VELO,
        "T_velo_to_cam": "0.1 -0.2 -0.3",
    } | changes  # fmt: skip
    return "# made\ndate: 26-Sep-2011\n" + "".join(f"{key}: {value}\n" for key, value in lines.items())


def drive(folder: Path, frames: int = 3, images: str = "image_02", scans: str = "velodyne") -> Path:
    (folder / images).mkdir(parents=True)
    (folder / scans).mkdir(parents=True)
    for k in range(frames):
        cv2.imwrite(str(folder / images / f"{k:010d}.png"), IMAGE[..., ::-1])
        (folder / scans / f"{k:010d}.bin").write_bytes((POINTS + k).tobytes())
    return folder


def simple(folder: Path, **changes: str) -> Path:
    drive(folder)
    (folder / "calib.txt").write_text(calibration(**changes))
    return folder


def test_image_and_scan_of_a_frame_carry_one_stamp(tmp_path: Path) -> None:
    played = play(KittiRaw(path=str(simple(tmp_path)), first_stamp=5, start=1))
    assert [m.stamp for m in played["points"]] == [m.stamp for m in played["image"]] == [100_000_005, 200_000_005]
    cloud, image = played["points"][0], played["image"][0]
    assert isinstance(cloud, PointCloud)
    assert isinstance(image, Image)
    np.testing.assert_array_equal(cloud.points, POINTS[:, :3] + 1)
    assert cloud.intensities is not None
    np.testing.assert_array_equal(cloud.intensities, POINTS[:, 3] + 1)
    np.testing.assert_array_equal(image.data, IMAGE)


def test_the_extrinsics_take_the_lidar_to_the_colour_camera_beside_the_reference_camera(tmp_path: Path) -> None:
    folder = drive(tmp_path / "day" / "drive", images="image_02/data", scans="velodyne_points/data")
    text = calibration(offset=6.0)
    (folder.parent / "calib_cam_to_cam.txt").write_text(text)
    (folder.parent / "calib_velo_to_cam.txt").write_text(f"R: {R_VELO}\nT: 0.1 -0.2 -0.3\n")
    (folder / "velodyne_points" / "timestamps.txt").write_text(
        "".join(f"2011-09-26 13:02:25.{k}94560375\n" for k in range(3))
    )
    played = play(KittiRaw(path=str(folder)))
    (info,), (extrinsics,) = played["image_info"], played["extrinsics"]
    assert isinstance(info, CameraInfo)
    assert isinstance(extrinsics, Transforms)
    assert (info.fx, info.K[0, 2], info.width, info.height) == (100, 3, 6, 4)
    T = np.linalg.inv(extrinsics.matrix("camera_optical"))
    np.testing.assert_allclose(T @ [10, 0, 0, 1], [0.16, -0.2, 9.7, 1], atol=1e-12)
    assert [m.stamp - 1_317_042_145_000_000_000 for m in played["points"]] == [94_560_375, 194_560_375, 294_560_375]


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda f: (f / "calib.txt").unlink(), "no calibration in"),
        (lambda f: (f / "calib.txt").write_text(calibration(R_rect_00="1 0 0")), "R_rect_00 must have 9 finite"),
        (lambda f: (f / "calib.txt").write_text(calibration(P_rect_02="0 " * 12)), "focal lengths 0.0 and 0.0"),
        (lambda f: (f / "calib.txt").write_text("R_rect_00: 1 0 0 0 1 0 0 0 1"), "no P_rect_02"),
        (lambda f: [p.unlink() for p in (f / "velodyne").iterdir()], "no .bin files in"),
        (lambda f: (f / "image_02" / "0000000000.png").write_bytes(b"x"), "cannot decode"),
    ],
)  # fmt: skip
def test_a_folder_that_cannot_be_used_is_refused_by_name(tmp_path: Path, break_it: Any, message: str) -> None:
    folder = simple(tmp_path)
    break_it(folder)
    with pytest.raises(SourceError, match=message):
        KittiRaw(path=str(folder), strict=True).setup()


def test_a_frame_that_lacks_a_file_is_passed_over_and_the_others_keep_their_times(tmp_path: Path) -> None:
    """As in 2011_09_26_drive_0009, of which four scans are missing and all times are there."""
    folder = simple(tmp_path)
    (folder / "velodyne_points").mkdir(exist_ok=True)
    times = [f"2011-09-26 13:02:25.{k}94560375\n" for k in range(3)]
    (folder / "velodyne_points" / "timestamps.txt").write_text("".join(times))
    (folder / "velodyne" / "0000000001.bin").unlink()
    (folder / "image_02" / "0000000000.png").write_bytes(b"x")
    source = KittiRaw(path=str(folder))

    played = play(source)

    assert [m.stamp % 1_000_000_000 for m in played["points"]] == [294_560_375]
    assert source.summary() == {"passed_over": 2}


def test_a_scan_that_was_cut_off_is_named(tmp_path: Path) -> None:
    folder = simple(tmp_path)
    (folder / "velodyne" / "0000000001.bin").write_bytes(b"x" * 17)
    source = KittiRaw(path=str(folder), strict=True)
    source.setup()
    with pytest.raises(SourceError, match=r"0000000001\.bin has 17 bytes; 16 a point expected"):
        list(source.stream())


@pytest.mark.data
def test_a_real_drive_is_read(data_dir: Path) -> None:
    source = KittiRaw(path=str(data_dir / "kitti_lidar_camera"), stop=2)
    source.setup()
    first = next(iter(source.stream()))["points"]
    assert isinstance(first, PointCloud)
    assert (source.length(), first.count) == (2, 114278)
