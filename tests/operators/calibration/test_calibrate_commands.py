"""`dataflow calibrate` on recordings of made boards: what it finds, writes, prints and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_boards import Array, Lens, picture, pose, texture, turned
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from dataflow.api.names import StreamNameError
from dataflow.api.recordings import open as opened
from dataflow.messages import CameraInfo, CompressedImage, Image, Imu
from dataflow.recording import RecordingWriter
from dataflow.testing import play
from operators.calibration.boards import Board, Charuco, Chessboard
from operators.calibration.commands import calibrate
from operators.calibration.recorded import BoardViews, images_of, own_frames, spaced_pairs
from operators.geometry.calibration_files import camera_text
from operators.sources import ImageFolder, StaticTransforms

LEFT = Lens(320, 240, 280.0, 283.0, 164.0, 116.0)
RIGHT = Lens(320, 240, 277.0, 279.0, 157.0, 122.0, (-0.2, 0.05, 0.0, 0.001, 0.0))
T_LEFT_RIGHT = np.eye(4)
T_LEFT_RIGHT[:3, :3], T_LEFT_RIGHT[:3, 3] = turned(0.01, -0.03, 0.02), (0.12, 0.004, -0.003)
R_IMU_CAMERA = turned(0.3, -1.2, 2.0)
LATE = 0.0237
MS = 1_000_000
CHARUCO = "--charuco 8x6 --square 0.04 --marker 0.028 --dictionary 4X4_50"


def run(line: str, code: int = 0) -> str:
    done = CliRunner().invoke(calibrate, line.split())
    assert done.exit_code == code, (done.output, done.exception)
    return " ".join((done.stderr if code else done.stdout).split())


def image(board: Board, drawn: Array, lens: Lens, T: Array, stamp: int, frame: str) -> Image:
    return Image(stamp=stamp, frame=frame, data=picture(board, drawn, lens, T))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """10 views of a ChArUco board, nearly synchronous, by two cameras; the right one's are PNG files."""
    board, rng = Charuco(7, 5, 0.04, 0.028, "4X4_50"), np.random.default_rng(8)
    drawn, file = texture(board), tmp_path_factory.mktemp("pair") / "board.mcap"
    with RecordingWriter(file, metadata={}) as writer:
        writer.add_stream("cameras/left", Image)
        writer.add_stream("cameras/right", CompressedImage)
        for k in range(10):
            far = rng.uniform(0.35, 0.65)
            place = (rng.uniform(-0.25, 0.35) * far, rng.uniform(-0.25, 0.25) * far, far)
            T = pose(board, turned(*rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.3, 0.3)), place)
            stamp = (k + 1) * 300 * MS
            writer.write("cameras/left", image(board, drawn, LEFT, T, stamp, "left"), seq=k)
            seen = picture(board, drawn, RIGHT, np.linalg.inv(T_LEFT_RIGHT) @ T)
            data = cv2.imencode(".png", seen)[1].ravel()
            packed = CompressedImage(stamp=stamp + MS, frame="right", format="png", data=data)
            writer.write("cameras/right", packed, seq=k)
    return file


def test_a_camera_is_found_and_its_file_is_taken_by_a_source(pair: Path, tmp_path: Path) -> None:
    found = json.loads(run(f"camera {pair} {CHARUCO} --image left --out {tmp_path} --json"))

    assert found["images"] == 10
    assert found["rms"] < 0.4
    assert np.array(found["K"]) == pytest.approx(LEFT.K, abs=4)
    assert found["files"] == [str(tmp_path / "camera.yaml"), str(tmp_path / "camera.png")]
    assert cv2.imread(found["files"][1]).shape == (240, 320, 3)
    assert len(found["views"]) == found["with_board"] - found["left_out"]
    assert found["covered"] > 0.4

    (tmp_path / "shots").mkdir()
    cv2.imwrite(str(tmp_path / "shots" / "1.png"), np.zeros((240, 320), np.uint8))
    source = ImageFolder(path=str(tmp_path / "shots"), calibration=str(tmp_path / "camera.yaml"), frame="eye")
    [info] = play(source)["image_info"]
    assert isinstance(info, CameraInfo)
    assert (info.frame, info.distortion_model) == ("eye", "plumb_bob")
    assert pytest.approx(np.array(found["K"]), rel=1e-8) == info.K
    assert info.distortion == pytest.approx(np.array(found["distortion"]), rel=1e-8)
    assert str(tmp_path / "camera.yaml") in source.files


def test_words_name_residuals_coverage_and_poor_data(pair: Path, tmp_path: Path) -> None:
    out = run(f"camera {pair} {CHARUCO} --image left --every 0.7 --out {tmp_path}")

    assert "cameras/left: 4 views, of 4 with the board in 4 images of 10 (--every 0 looks at all); residual 0." in out
    assert "px boards" not in out
    assert "boards were in" in out
    assert "warning: 4 views are few" in out
    assert f"written: {tmp_path}/camera.yaml, {tmp_path}/camera.png" in out


@pytest.mark.long
def test_a_pair_is_found_and_its_files_are_taken_by_sources(pair: Path, tmp_path: Path) -> None:
    found = json.loads(run(f"stereo {pair} {CHARUCO} --out {tmp_path} --tolerance 0.002 --json"))

    assert np.array(found["T_left_right"]) == pytest.approx(T_LEFT_RIGHT, abs=0.02)
    assert found["baseline"] == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]), abs=2e-3)
    assert found["row_difference"] < 0.5
    [extrinsics] = play(StaticTransforms(paths=(str(tmp_path / "stereo.yaml"),)))["extrinsics"]
    assert (extrinsics.frames, extrinsics.child_frames) == (("left",), ("right",))
    assert extrinsics.translations[0] == pytest.approx(np.array(found["T_left_right"])[:3, 3], rel=1e-6)
    assert {file.name for file in tmp_path.iterdir()} == {
        "left.yaml", "left.png", "right.yaml", "right.png", "stereo.yaml",
    }  # fmt: skip
    assert "baseline" in run(f"stereo {pair} {CHARUCO} --model equidistant --every 0 --out {tmp_path} --overwrite")


def test_the_name_of_a_camera_means_its_only_stream_of_images(tmp_path: Path) -> None:
    info = CameraInfo(stamp=0, frame="a", width=1, height=1, distortion_model="plumb_bob", K=np.eye(3))
    with RecordingWriter(tmp_path / "pair.mcap", metadata={}) as writer:
        for name in ("left/image", "right/image", "right/second"):
            writer.add_stream(name, Image)
            writer.write(name, Image(stamp=0, frame="a", data=np.zeros((1, 1), np.uint8)), seq=0)
        writer.add_stream("left/image_info", CameraInfo, static=True)
        writer.write("left/image_info", info, seq=0)
    with opened(tmp_path / "pair.mcap") as streams:
        assert images_of(streams, "left", "--left").info.name == "left/image"
        with pytest.raises(StreamNameError, match="no stream 'right'"):
            images_of(streams, "right", "--right")


@pytest.mark.parametrize(
    ("streams", "frames"),
    [
        (("robot/left/image", "robot/right/image"), ("left", "right")),
        (("cam0", "cam1"), ("cam0", "cam1")),
        (("a/left/raw", "b/right/image"), ("a/left/raw", "b/right/image")),
        (("eyes", "eyes/right"), ("eyes", "right")),
    ],
)
def test_cameras_with_one_frame_get_frames_from_their_streams(
    streams: tuple[str, str], frames: tuple[str, str]
) -> None:
    board = Chessboard(9, 6, 0.03)
    left, right = (BoardViews(name, "camera_optical", board, (320, 240), 0, ()) for name in streams)
    found = own_frames(left, right)

    assert tuple(seen.frame for seen in found) == frames
    assert own_frames(*found) == found


def test_pairs_are_spaced_together_when_one_camera_begins_later_and_loses_an_image(tmp_path: Path) -> None:
    pixels, period, names = np.zeros((1, 1), np.uint8), 10**9 // 30, ("left", "right")
    with RecordingWriter(tmp_path / "pair.mcap", metadata={}) as writer:
        for name in names:
            writer.add_stream(name, Image)
        for k in range(300):
            if k != 40:
                writer.write("left", Image(stamp=k * period, frame="left", data=pixels), seq=k)
            if k >= 3:
                writer.write("right", Image(stamp=k * period + MS // 5, frame="right", data=pixels), seq=k)
    with opened(tmp_path / "pair.mcap") as streams:
        left, right = (streams[name] for name in names)
        places = spaced_pairs(left, right, 0.25, 5 * MS)
        apart = right.stamps[places[1]] - left.stamps[places[0]]
        with pytest.raises(ValueError, match=r"no image of left lies within 0.1 ms of one of right: --tolerance takes"):
            spaced_pairs(left, right, 0.25, MS // 10)

    assert len(apart) == 38
    assert (apart == MS // 5).all()


@pytest.mark.long
def test_a_camera_beside_an_imu_is_found(tmp_path: Path) -> None:
    board, file = Chessboard(9, 6, 0.03), tmp_path / "turning.mcap"
    drawn, rng = texture(board), np.random.default_rng(1)

    def facing(t: float) -> Array:
        return turned(0.2 * np.sin(2.1 * t), 0.25 * np.sin(1.7 * t + 1), 0.3 * np.sin(2.6 * t + 2))

    with RecordingWriter(file, metadata={}) as writer:
        writer.add_stream("imu/sample", Imu)
        writer.add_stream("camera/image", Image)
        writer.add_stream("camera/info", CameraInfo, static=True)
        info = CameraInfo(
            stamp=0, frame="camera", width=320, height=240, distortion_model="plumb_bob", K=LEFT.K,
            distortion=np.array(LEFT.bend),
        )  # fmt: skip
        writer.write("camera/info", info, seq=0)
        for k, t in enumerate(np.arange(-0.7, 6.7, 0.01)):
            turn = Rotation.from_matrix(facing(t - 5e-4) @ facing(t + 5e-4).T).as_rotvec() * 1e3
            sample = Imu(
                stamp=round((t + 1) * 1e9), frame="imu", angular_velocity=R_IMU_CAMERA @ turn + rng.normal(0, 0.003, 3),
                linear_acceleration=np.array([0, 0, 9.81]),
            )  # fmt: skip
            writer.write("imu/sample", sample, seq=k)
        for k, t in enumerate(np.arange(0, 6, 0.1)):
            T = pose(board, facing(t), (0.02, 0, 0.45))
            writer.write("camera/image", image(board, drawn, LEFT, T, round((t + 1 + LATE) * 1e9), "camera"), seq=k)
    words = f"camera-imu {file} --chessboard 9x6 --square 0.03 --image camera/image --imu imu/sample --out {tmp_path}"
    found = json.loads(run(f"{words} --json"))

    assert found["offset"] == pytest.approx(LATE, abs=2e-3)
    assert Rotation.from_matrix(np.array(found["R_imu_camera"]).T @ R_IMU_CAMERA).magnitude() < np.radians(0.5)
    assert "the translation was not measured" in (tmp_path / "camera_imu.yaml").read_text()
    [extrinsics] = play(StaticTransforms(paths=(str(tmp_path / "camera_imu.yaml"),)))["extrinsics"]
    assert (extrinsics.frames, extrinsics.child_frames) == (("imu",), ("camera",))
    (tmp_path / "camera.yaml").write_text(camera_text(info))
    out = run(f"{words} --camera {tmp_path}/camera.yaml --overwrite")
    assert "images are stamped 2" in out
    assert "later than the IMU's samples" in out


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("camera PAIR --square 0.03", "one of --chessboard NxM (inner corners) and --charuco"),
        ("camera PAIR --square 0.03 --charuco 8x6", "needs --marker"),
        ("camera PAIR --square 0.03 --chessboard 9by6", "such as 9x6, got '9by6'"),
        (
            "camera PAIR --square 0.03 --chessboard 9x6",
            "2 streams of images (cameras/left, cameras/right): --image names",
        ),
        ("camera PAIR --square 0.03 --chessboard 9x6 --image lef", "no stream 'lef'"),
        (
            "camera PAIR --square 0.03 --chessboard 9x6 --image left --model fish",
            "no lens model 'fish'; there are plumb",
        ),
        (
            "camera PAIR --square 0.03 --charuco 8x6 --marker 0.02 --image left --every 2",
            "no board in 2 images of 10 (--every 0 looks at all)",
        ),
        ("camera PAIR --square 25 --chessboard 9x6", "squares of 25 m: --square is in metres; 25 mm are 0.025"),
        ("stereo PAIR --square 0.03 --chessboard 8x6", "looks the same upside down"),
        ("camera-imu PAIR --square 0.03 --chessboard 9x6 --image left", "0 streams of samples of an IMU (none)"),
        ("camera nowhere.mcap --square 0.03 --chessboard 9x6", "no recording nowhere.mcap"),
    ],
)
def test_invalid_calibration_command_is_refused_in_one_line(line: str, wrong: str, pair: Path, tmp_path: Path) -> None:
    assert wrong in run(f"{line.replace('PAIR', str(pair))} --out {tmp_path}", code=2)
    assert not list(tmp_path.iterdir())


def test_files_that_are_there_stay(pair: Path, tmp_path: Path) -> None:
    (tmp_path / "camera.png").write_text("mine")
    said = run(f"camera {pair} {CHARUCO} --image left --out {tmp_path}", code=2)

    assert "camera.png is there; --overwrite replaces it" in said
    assert (tmp_path / "camera.png").read_text() == "mine"
