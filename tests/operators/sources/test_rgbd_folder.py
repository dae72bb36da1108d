"""RgbdFolder on folders written by the tests, in both layouts, and on the real frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from dataflow.messages import CameraInfo, DepthImage, Image, Message, Pose, Transforms
from dataflow.messages.geometry import transform_matrix
from dataflow.operator import ParameterError, SourceError
from operators.sources import RgbdFolder

COLOR = np.zeros((6, 8, 3), np.uint8)
COLOR[..., 0], COLOR[..., 2] = 200, 10  # RGB: reddish
DEPTH = np.full((6, 8), 1500, np.uint16)
DEPTH[0, :4] = 0, 65535, 6000, 6001
T_QUARTER = np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1.0]])  # 90° about z


def write_7scenes(folder: Path, numbers: range = range(3)) -> Path:
    for k in numbers:
        stem = folder / f"frame-{k:06d}"
        cv2.imwrite(f"{stem}.color.png", COLOR[..., ::-1])
        cv2.imwrite(f"{stem}.depth.png", DEPTH)
        np.savetxt(f"{stem}.pose.txt", T_QUARTER + np.diag([0, 0, 0.01, 0]))  # not quite orthonormal
    np.savetxt(folder / "camera-intrinsics.txt", [[7, 0, 4], [0, 7, 3], [0, 0, 1]])
    return folder


def write_tum(folder: Path) -> Path:
    """Three colour images; depth is 5 ms late, the second frame has no truth, the third no depth."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    rgb, depth = ["# color images"], []
    for k, seconds in enumerate(("10.000000", "10.1000001", "10.200000")):
        cv2.imwrite(str(folder / f"rgb/{k}.png"), COLOR[..., ::-1])
        rgb.append(f"{seconds} rgb/{k}.png")
    for k, seconds in enumerate(("10.005", "10.105", "10.3")):
        cv2.imwrite(str(folder / f"depth/{k}.png"), DEPTH)
        depth.append(f"{seconds} depth/{k}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb))
    (folder / "depth.txt").write_text("\n".join(depth))
    (folder / "groundtruth.txt").write_text("9.999 1 2 3 0 0 0.70710678 0.70710678\n10.2 9 9 9 0 0 0 1\n")
    return folder


def read(folder: Path, **params: object) -> tuple[RgbdFolder, list[dict[str, Message]]]:
    source = RgbdFolder(path=str(folder), **params)
    source.setup()
    return source, [dict(messages) for messages in source.stream()]


def test_7scenes_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    source, frames = read(write_7scenes(tmp_path))
    assert source.length() == len(frames) == 3
    again = read(tmp_path)[1]
    assert [[m.digest() for m in frame.values()] for frame in frames] == [
        [m.digest() for m in frame.values()] for frame in again
    ]
    image, depth = frames[1]["image"], frames[1]["depth"]
    assert isinstance(image, Image)
    assert isinstance(depth, DepthImage)
    np.testing.assert_array_equal(image.data, COLOR)
    assert depth.data[0, :5].tolist() == [0, 0, 6, 0, 1.5]  # no return, invalid, the farthest, beyond, ordinary
    unlimited = read(tmp_path, max_depth=100)[1][1]["depth"]
    assert unlimited.data[0, :4].tolist() == [0, 0, 6, np.float32(6.001)]
    statics = source.static_outputs()
    depth_info, image_info, extrinsics = (statics[p] for p in ("depth_info", "image_info", "extrinsics"))
    assert isinstance(depth_info, CameraInfo)
    assert isinstance(image_info, CameraInfo)
    assert isinstance(extrinsics, Transforms)
    assert (depth_info.fx, depth_info.cx, depth_info.cy, depth_info.width, depth_info.height) == (7, 4, 3, 8, 6)
    assert (image_info.fx, image_info.fy, image_info.cx) == (525, 525, 4)
    assert (depth_info.frame, image_info.frame) == (depth.frame, image.frame)
    assert extrinsics.frames == (depth.frame,)
    np.testing.assert_array_equal(extrinsics.matrix(image.frame), transform_matrix([0.025, 0, 0], [0, 0, 0, 1]))


def test_poses_are_made_rigid(tmp_path: Path) -> None:
    pose = read(write_7scenes(tmp_path))[1][0]["ground_truth"]
    assert isinstance(pose, Pose)
    assert (pose.frame, pose.child_frame) == ("world", "camera_depth_optical")
    np.testing.assert_allclose(pose.matrix(), T_QUARTER, atol=1e-12)


@pytest.mark.parametrize("rate", [30, 29.97, 7])
def test_stamps_are_exact_and_the_same_for_every_slice(tmp_path: Path, rate: float) -> None:
    write_7scenes(tmp_path, range(5, 15))
    thousandths = round(rate * 1000)
    expected = [100 + k * 10**12 // thousandths for k in range(5, 15)]
    stamps = [m["image"].stamp for m in read(tmp_path, rate=rate, first_stamp=100)[1]]
    assert stamps == expected
    sliced = read(tmp_path, rate=rate, first_stamp=100, start=2, stop=9, stride=3)[1]
    assert [m["depth"].stamp for m in sliced] == expected[2:9:3]


def test_a_frame_without_pose_has_no_ground_truth(tmp_path: Path) -> None:
    write_7scenes(tmp_path)
    (tmp_path / "frame-000001.pose.txt").unlink()
    np.savetxt(tmp_path / "frame-000002.pose.txt", np.full((4, 4), -np.inf))
    np.savetxt(tmp_path / "frame-000000.pose.txt", np.diag([-1.0, 1, 1, 1]))  # left-handed axes
    source, frames = read(tmp_path)
    assert ["ground_truth" in messages for messages in frames] == [False] * 3
    assert source.summary()["passed_over"] == 1
    file = write_tum(tmp_path / "tum") / "groundtruth.txt"
    file.write_text("9.999 nan nan nan nan nan nan nan\n10.1 1 2 3 0 0 0 1\n")
    assert ["ground_truth" in frame for frame in read(tmp_path / "tum")[1]] == [False, True]


def test_tum_frames_are_associated_by_nearest_stamp(tmp_path: Path) -> None:
    source, frames = read(write_tum(tmp_path))
    assert [m["image"].stamp for m in frames] == [10_000_000_000, 10_100_000_100]
    assert all(m["depth"].stamp == m["image"].stamp for m in frames)
    assert ["ground_truth" in m for m in frames] == [True, False]
    pose, depth = frames[0]["ground_truth"], frames[0]["depth"]
    assert isinstance(pose, Pose)
    assert isinstance(depth, DepthImage)
    np.testing.assert_allclose(pose.matrix(), T_QUARTER, atol=1e-7)
    np.testing.assert_allclose(depth.data[1, 0], 0.3, rtol=1e-6)  # 1500 / 5000
    info = source.static_outputs()["image_info"]
    assert isinstance(info, CameraInfo)
    assert (info.fx, info.cx, info.cy) == (525, 319.5, 239.5)


def test_given_calibration_and_names_win(tmp_path: Path) -> None:
    source, frames = read(
        write_7scenes(tmp_path),
        image_intrinsics=(500, 501, 4.5, 3.5),
        depth_intrinsics=(600, 601, 4, 3),
        T_depth_image=(0.025, 0, 0, 0, 0, 0, 1),
        image_frame="rgb",
        depth_frame="ir",
        max_depth=1.0,
    )
    statics = source.static_outputs()
    extrinsics, image_info = statics["extrinsics"], statics["image_info"]
    assert isinstance(extrinsics, Transforms)
    assert isinstance(image_info, CameraInfo)
    assert extrinsics.matrix("rgb")[0, 3] == 0.025
    assert image_info.K.tolist() == [[500, 0, 4.5], [0, 501, 3.5], [0, 0, 1]]
    assert [m["image"].frame for m in frames] == ["rgb"] * 3
    assert not frames[0]["depth"].data.any()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "frame-000001.depth.png").unlink(), r"frame 000001 has no depth image: no .*frame-000001"),
        (lambda f: (f / "frame-000001.color.png").unlink(), r"frame 000001 has no colour image"),
        (lambda f: (f / "frame-000001.color.png").write_bytes(b"junk"), r"frame 000001: cannot decode .*color\.png"),
        (lambda f: (f / "frame-000001.depth.png").write_bytes(b""), r"frame 000001: cannot decode .*depth\.png"),
        (lambda f: cv2.imwrite(str(f / "frame-000001.depth.png"), COLOR), r"frame 000001: .* one 16-bit channel"),
        (lambda f: cv2.imwrite(str(f / "frame-000001.depth.png"), DEPTH[:4]), r"has 8x4 pixels, but the first .* 8x6"),
        (lambda f: (f / "frame-000001.pose.txt").write_text("1 2 3"), r"pose\.txt: expected 4x4 numbers, found 3"),
        (lambda f: np.savetxt(f / "frame-000001.pose.txt", 2 * T_QUARTER), r"frame 000001: not a rigid motion"),
        (lambda f: np.savetxt(f / "camera-intrinsics.txt", -np.eye(3)), r"camera-intrinsics\.txt: not an intrinsic"),
    ],
)
def test_a_spoiled_file_is_named_with_its_frame(tmp_path: Path, spoil, message: str) -> None:
    spoil(write_7scenes(tmp_path))
    with pytest.raises(SourceError, match=message):
        read(tmp_path, strict=True)


@pytest.mark.parametrize("name", ["color.png", "depth.png", "pose.txt"])
@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("gone", [True, False])
def test_a_frame_that_cannot_be_read_is_passed_over_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, number: int, gone: bool
) -> None:
    whole = read(write_7scenes(tmp_path))[1]
    file = tmp_path / f"frame-{number:06d}.{name}"
    file.unlink() if gone else file.write_bytes(b"1 2")
    caplog.clear()

    source, frames = read(tmp_path)
    source.static_outputs()

    if name == "pose.txt":
        assert [set(frame) for frame in frames] == [
            {"image", "depth"} | ({"ground_truth"} if k != number else set()) for k in range(3)
        ]
    else:
        left = [frame for k, frame in enumerate(whole) if k != number]
        assert [f["image"].digest() for f in frames] == [f["image"].digest() for f in left]
    truthless = gone and name == "pose.txt"  # which is usual
    assert source.summary() == {"passed_over": 0 if truthless else 1}
    assert (f"frame-{number:06d}" in caplog.text) is not truthless


def test_a_folder_of_which_no_frame_can_be_read_is_refused(tmp_path: Path) -> None:
    write_7scenes(tmp_path)
    for file in tmp_path.glob("*.depth.png"):
        cv2.imwrite(str(file), np.zeros((6, 8), np.uint8))

    with pytest.raises(SourceError, match=r"frame 000000: .* one 16-bit channel"):
        read(tmp_path)


def test_tum_lists_of_other_systems(tmp_path: Path) -> None:
    """A byte order mark, lines of Windows, names with spaces, a line twice, and lines out of order."""
    write_tum(tmp_path)
    whole = [frame["image"].digest() for frame in read(tmp_path)[1]]
    lines = [line for line in (tmp_path / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    stamp, name = lines[0].split()
    (tmp_path / name).rename(tmp_path / "rgb" / "the first.png")
    lines[0] = f"{stamp} rgb/the first.png"
    (tmp_path / "rgb.txt").write_bytes(b"\xef\xbb\xbf" + "\r\n".join(["# names", *lines[::-1], lines[0]]).encode())

    assert [frame["image"].digest() for frame in read(tmp_path)[1]] == whole


NO_TIME = r"depth\.txt:1: .* is no time from 1970 to 2262"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1700000000033000000 depth/0.png", NO_TIME + r".*is it in nanoseconds\?$"),
        ("1700000000033000 depth/0.png", NO_TIME + r".*is it in microseconds\?$"),
        ("1700000000033 depth/0.png", NO_TIME + r".*is it in milliseconds\?$"),
        ("-4.5 depth/0.png", NO_TIME + "$"),
        ("10.0 depth/0.png\nsoon depth/1.png", r"depth\.txt:2: 'soon' is no time in seconds"),
        ("10.0 depth/9.png", r"no file .*depth/9\.png"),
        ("10.0 depth/0.png".encode("utf-16"), r"depth\.txt is no text in UTF-8"),
    ],
)
def test_spoiled_tum_lists_are_named_with_their_line(tmp_path: Path, text: str | bytes, words: str) -> None:
    (write_tum(tmp_path) / "depth.txt").write_bytes(text.encode() if isinstance(text, str) else text)

    with pytest.raises(SourceError, match=words):
        read(tmp_path, strict=True)


def test_folders_and_slices_without_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="holds neither the 7-Scenes layout"):
        read(tmp_path)
    with pytest.raises(SourceError, match=r"no folder .*nowhere"):
        read(tmp_path / "nowhere")
    write_7scenes(tmp_path)
    with pytest.raises(SourceError, match="has 3 frames: start=5"):
        read(tmp_path, start=5)
    with pytest.raises(ParameterError, match=r"RgbdFolder\.rate"):
        RgbdFolder(path=str(tmp_path), rate=0)


@pytest.mark.data
def test_the_real_frames_have_their_known_properties(data_dir: Path) -> None:
    source, frames = read(data_dir / "rgbd_7scenes", start=240)
    assert len(frames) == 10
    for k, messages in enumerate(frames, 240):
        image, depth, pose = messages["image"], messages["depth"], messages["ground_truth"]
        assert isinstance(image, Image)
        assert isinstance(depth, DepthImage)
        assert isinstance(pose, Pose)
        assert image.stamp == k * 10**9 // 30
        assert image.data.shape == (480, 640, 3)
        assert 0.5 < (depth.data > 0).mean() <= 1
        assert depth.data.max() <= 6
        R = pose.matrix()[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    info = source.static_outputs()["depth_info"]
    assert isinstance(info, CameraInfo)
    assert info.fx == 585


def test_a_truth_of_another_clock_is_named_with_both_times(tmp_path: Path) -> None:
    (write_tum(tmp_path) / "groundtruth.txt").write_text("1700000000.0 0 0 0 0 0 0 1\n")

    with pytest.raises(SourceError, match=r"groundtruth\.txt: none of its 1 poses .* 1700000000\.000 to"):
        read(tmp_path)


def ramp(near: float, far: float, scale: float) -> np.ndarray:
    """A depth image that goes evenly from near to far, metres, with some of no return."""
    raw = np.linspace(near, far, 48).reshape(6, 8) * scale
    raw[0, :2], raw[1, 0] = 0, 65535
    return np.rint(raw).astype(np.uint16)


def depth_of(folder: Path, **params: object) -> float:
    """The depth (m) of the last pixel of the last frame."""
    return float(read(folder, max_depth=50, **params)[1][-1]["depth"].data[-1, -1])


def fill(folder: Path, raw: np.ndarray) -> Path:
    """Replaces the depth images of a folder of either layout."""
    for file in folder.rglob("*.png"):
        if "color" not in file.name and file.parent.name != "rgb":
            cv2.imwrite(str(file), raw)
    return folder


@pytest.mark.parametrize(
    ("write", "unit", "guessed"),
    [(write_tum, 1000, True), (write_tum, 5000, False), (write_7scenes, 5000, True), (write_7scenes, 1000, False)],
)
def test_the_values_show_the_unit_of_depth(tmp_path: Path, write, unit, guessed, caplog) -> None:
    caplog.set_level("INFO")
    folder = fill(write(tmp_path), ramp(0.8, 4.0, unit))

    assert depth_of(folder) == pytest.approx(4.0, abs=1e-3)
    assert depth_of(folder, start=1, stop=2) == pytest.approx(4.0, abs=1e-3)
    assert [("depth_scale" in r.message, r.levelname) for r in caplog.records] == [(True, "WARNING")] * 2 * guessed


@pytest.mark.parametrize(
    ("near", "far", "level"),
    [
        (0.4, 1.9, "INFO"),  # a table top; in millimetres a room
        (0.1, 1.6, "WARNING"),  # near a wall; in millimetres a room
        (12.0, 13.0, "WARNING"),  # far in either unit
    ],
)
def test_doubtful_depth_unit_keeps_that_of_the_layout_and_logs_once(
    tmp_path: Path, near: float, far: float, level: str, caplog
) -> None:
    caplog.set_level("INFO")
    folder = fill(write_tum(tmp_path), ramp(near, far, 5000))

    depth_of(folder)

    assert [r.levelname for r in caplog.records] == [level]
    assert "5000 units a metre" in caplog.records[0].message


def test_a_given_unit_is_taken_without_a_word(tmp_path: Path, caplog) -> None:
    caplog.set_level("INFO")
    folder = fill(write_tum(tmp_path), ramp(0.8, 4.0, 1000))

    assert depth_of(folder, depth_scale=4000) == pytest.approx(1.0, abs=1e-3)
    assert not caplog.records


def test_damaged_image_beyond_the_range_read_is_ignored(tmp_path: Path) -> None:
    fill(write_7scenes(tmp_path), ramp(0.8, 4.0, 1000))
    (tmp_path / "frame-000002.depth.png").write_bytes(b"junk")

    assert depth_of(tmp_path, stop=2) == pytest.approx(4.0)


def test_registered_depth_is_of_the_colour_camera(tmp_path: Path) -> None:
    statics = read(write_7scenes(tmp_path), registered=True)[0].static_outputs()

    assert statics["image_info"].K.tolist() == statics["depth_info"].K.tolist()
    np.testing.assert_array_equal(statics["extrinsics"].matrix("camera_color_optical"), np.eye(4))


def test_registration_that_contradicts_is_refused(tmp_path: Path) -> None:
    place = (0.05, 0, 0, 0, 0, 0, 1)
    with pytest.raises(SourceError, match="registered: false needs T_depth_image"):
        read(write_tum(tmp_path / "tum"), registered=False)
    source, _ = read(tmp_path / "tum", registered=False, T_depth_image=place)
    assert source.static_outputs()["extrinsics"].matrix("camera_color_optical")[0, 3] == 0.05
    with pytest.raises(SourceError, match="exclude each other"):
        read(tmp_path / "tum", registered=True, T_depth_image=place)
    fill(tmp_path / "tum", DEPTH[:4])
    with pytest.raises(SourceError, match=r"registered to colour, but its images have 8x4 pixels and those of .* 8x6"):
        read(tmp_path / "tum")
    read(tmp_path / "tum", image_intrinsics=(5, 5, 4, 3), depth_intrinsics=(5, 5, 4, 2))


@pytest.mark.data
@pytest.mark.parametrize("folder", ["rgbd_7scenes", "scenes/fr1_rpy", "scenes/cup_table"])
def test_real_folders_have_their_layouts_unit(data_dir: Path, folder: str, caplog) -> None:
    source = RgbdFolder(path=str(data_dir / folder))
    source.setup()

    assert not caplog.records


@pytest.mark.data
def test_real_millimetres_in_the_layout_of_tum_are_read_as_such(data_dir: Path, tmp_path: Path, caplog) -> None:
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for k in range(0, 250, 25):
        for name, file in (("rgb", f"frame-{k:06d}.color.jpg"), ("depth", f"frame-{k:06d}.depth.png")):
            lists[name].append(f"{k / 30:.6f} {data_dir / 'rgbd_7scenes' / file}")
    for name, lines in lists.items():
        (tmp_path / f"{name}.txt").write_text("\n".join(lines))

    depth = read(tmp_path)[1][0]["depth"]

    assert 1.0 < np.median(depth.data[depth.data > 0]) < 3.0
    assert "depth_scale" in caplog.text


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("rgb.txt", "10.15"),
        ("rgb.txt", "now rgb/1.png"),
        ("rgb.txt", "10.0 rgb/1.png"),
        ("depth.txt", "1e30 depth/1.png"),
        ("groundtruth.txt", "10.1 1 2 3 0 0"),
        ("groundtruth.txt", "10.1 1 2 3 0 0 0 0"),
        ("groundtruth.txt", "10.1 1 2 3 0 0 0 x"),
    ],
)
def test_a_line_that_cannot_be_read_is_passed_over_and_counted(tmp_path: Path, file: str, line: str) -> None:
    folder = write_tum(tmp_path)
    with (folder / file).open("a") as list_:
        list_.write(f"\n{line}\n")
    source, frames = read(folder)

    assert [frame["image"].stamp for frame in frames] == [10_000_000_000, 10_100_000_100]
    assert source.summary() == {"passed_over": 1, "without_depth": 1}
    with pytest.raises(SourceError, match=file):
        read(folder, strict=True)
