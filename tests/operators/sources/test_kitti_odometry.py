"""KITTI odometry folders are read as they are written, and what is wrong in them is named."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dataflow.messages import CameraInfo, Image
from dataflow.operator import SourceError
from dataflow.testing import play
from operators.sources import KittiOdometry
from operators.sources.kitti_odometry import read_poses, read_projections

K = np.array([[300.0, 0, 24], [0, 300, 16], [0, 0, 1]])
BASELINE = 0.5
SIZE = (48, 32)
Array = np.ndarray


def image(i: int, right: bool = False) -> Array:
    return np.random.default_rng([i, right]).integers(0, 255, SIZE[::-1], np.uint8)


def poses() -> list[Array]:
    made = []
    for i in range(3):
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.1 * i, 0.0]))[0]
        T[2, 3] = i
        made.append(T)
    return made


@pytest.fixture(params=[("image_0", "image_1"), ("image_2", "image_3"), ("image_l", "image_r")], ids=lambda p: p[0])
def pair(request: pytest.FixtureRequest) -> tuple[str, str]:
    return request.param


def written(folder: Path, pair: tuple[str, str] = ("image_0", "image_1")) -> Path:
    for right, name in enumerate(pair):
        (folder / name).mkdir()
        for i in range(3):
            cv2.imwrite(str(folder / name / f"{i:06}.png"), image(i, bool(right)))
    first = 2 if pair[0] == "image_2" else 0
    lines = []
    for camera, x in ((first, 0.0), (first + 1, -K[0, 0] * BASELINE)):
        lines.append(f"P{camera}: " + " ".join(map(str, np.column_stack([K, [x, 0, 0]]).ravel())))
    (folder / "calib.txt").write_text("\n".join(lines))
    (folder / "poses.txt").write_text("\n".join(" ".join(map(str, T[:3].ravel())) for T in poses()))
    return folder


def test_images_calibration_and_poses_are_those_of_the_files(tmp_path: Path, pair: tuple[str, str]) -> None:
    source = KittiOdometry(path=str(written(tmp_path, pair)), first_stamp=7)
    played = play(source)
    assert play(KittiOdometry(path=str(tmp_path), first_stamp=7)).digests() == played.digests()
    for i in range(3):
        for port in ("left", "right"):
            made = played[port][i]
            assert isinstance(made, Image)
            assert made.stamp == 7 + i * 100_000_000
            np.testing.assert_array_equal(made.data, image(i, port == "right"))
        np.testing.assert_allclose(played["ground_truth"][i].matrix(), poses()[i], atol=1e-9)
    info = source.static_outputs()["right_info"]
    assert isinstance(info, CameraInfo)
    assert info.P is not None
    assert (info.width, info.height, -info.P[0, 3] / info.P[0, 0]) == (*SIZE, BASELINE)
    assert source.length() == 3


def test_a_part_keeps_its_stamps_and_poses(tmp_path: Path) -> None:
    played = play(KittiOdometry(path=str(written(tmp_path)), start=1, stop=2, rate=5.0))
    assert [m.stamp for m in played["left"]] == [200_000_000]
    np.testing.assert_allclose(played["ground_truth"][0].matrix(), poses()[1], atol=1e-9)


def test_colour_images_are_rgb(tmp_path: Path) -> None:
    folder = written(tmp_path)
    blue = np.zeros((*SIZE[::-1], 3), np.uint8)
    blue[..., 0] = 200  # OpenCV writes BGR
    cv2.imwrite(str(folder / "image_0" / "000000.png"), blue)
    left = play(KittiOdometry(path=str(folder), stop=1, color=True))["left"][0]
    assert left.data[0, 0].tolist() == [0, 0, 200]


def test_a_folder_without_truth_gives_the_images_alone(tmp_path: Path) -> None:
    folder = written(tmp_path)
    (folder / "poses.txt").unlink()
    played = play(KittiOdometry(path=str(folder)))
    assert (len(played["left"]), played["ground_truth"]) == (3, [])


def test_a_calibration_without_names_is_read_by_its_lines(tmp_path: Path) -> None:
    folder = written(tmp_path)
    lines = (folder / "calib.txt").read_text().splitlines()
    (folder / "calib.txt").write_text("\n".join(line.partition(" ")[2] for line in lines))
    left, right = read_projections(folder / "calib.txt", (0, 1))
    np.testing.assert_array_equal(left[:, :3], K)
    assert right[0, 3] == -150.0


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("calib.txt", "P0: 1 2 3", "projection P0 must be 12 numbers"),
        ("calib.txt", None, r"calib\.txt"),
        ("calib.txt", "P0: " + "1 " * 12 + "\nP1: " + "1 " * 12, r"P1\[0, 3\] must be below P0\[0, 3\]"),
        ("poses.txt", "1 0 0", "pose of line 1 must be 12 numbers"),
        ("poses.txt", "nan " * 12, "pose of line 1 must be 12 numbers"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0", "has 1 poses, and there are more images"),
    ],
)
def test_a_folder_that_is_broken_is_named(tmp_path: Path, file: str, text: str | None, words: str) -> None:
    folder = written(tmp_path)
    if text is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(text)
    with pytest.raises((SourceError, FileNotFoundError), match=words):
        KittiOdometry(path=str(folder)).setup()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"no image", r"cannot decode .*image_1.000001\.png"),
        (cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes(), "has 8x8 pixels, the first image 48x32"),
        (None, r"no file .*image_1.000001\.png"),
    ],
    ids=["no image", "another size", "missing"],
)
def test_an_image_that_cannot_be_used_is_named(tmp_path: Path, content: bytes | None, words: str) -> None:
    file = written(tmp_path) / "image_1" / "000001.png"
    file.unlink() if content is None else file.write_bytes(content)
    source = KittiOdometry(path=str(tmp_path), strict=True)
    source.setup()
    with pytest.raises(SourceError, match=words):
        list(source.stream())


def test_a_pair_that_cannot_be_read_is_passed_over_and_the_others_keep_their_stamps(tmp_path: Path) -> None:
    folder = written(tmp_path)
    (folder / "image_1" / "000001.png").write_bytes(b"no image")
    (folder / "image_0" / "000000.png").write_bytes(b"no image")
    source = KittiOdometry(path=str(folder))

    played = play(source)

    assert [m.stamp for m in played["left"]] == [m.stamp for m in played["ground_truth"]] == [200_000_000]
    assert source.summary() == {"passed_over": 2}


def test_a_folder_without_images_and_a_span_without_any_are_named(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="holds no pair of folders: image_l/image_r"):
        KittiOdometry(path=str(tmp_path)).setup()
    with pytest.raises(SourceError, match=r"holds no image \*\.png from 3 to None"):
        KittiOdometry(path=str(written(tmp_path)), start=3).setup()


def test_poses_are_made_orthonormal(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1.0001 0 0 1 0 1 0 2 0 0 0.9999 3")
    (T,) = read_poses(tmp_path / "poses.txt")
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
