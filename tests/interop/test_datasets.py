"""Datasets that are read back by what others read them with: pyarrow, numpy, and this project's own KITTI reader."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from exporting import exported
from made_recordings import of_robot
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.interop.export import frames
from dataflow.interop.export.datasets import DATASETS, export_7scenes, export_kitti, export_tum, tell_untaken
from dataflow.interop.export.kitti_raw import export_kitti_raw
from dataflow.interop.export.lerobot import export_lerobot
from dataflow.interop.export.lerobot_layouts import Layout30
from dataflow.interop.export.report import Exported
from dataflow.interop.export.source import ExportSource
from dataflow.messages import (
    CameraInfo,
    DepthImage,
    Image,
    JointState,
    Message,
    Number,
    PointCloud,
    Pose,
    Text,
    Transforms,
    Twist,
)
from dataflow.recording import RecordingError
from operators.sources.kitti_raw import KittiRaw

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def arm(frames: int = 6) -> dict[str, list[Message]]:
    """A camera at 10 Hz, joints at 50 Hz and commands that begin after the first image."""
    rng = np.random.default_rng(0)
    joints = [
        JointState(stamp=START + k * SECOND // 50, names=("a", "b"), positions=[k, -k]) for k in range(frames * 5)
    ]
    stamps = [START + k * SECOND // 10 for k in range(frames)]
    commands = [
        Twist(stamp=stamp + SECOND // 20, frame="b", linear=[k, 0, 0], angular=[0, 0, 0])
        for k, stamp in enumerate(stamps)
    ]
    images = [Image(stamp=s, frame="c", data=rng.integers(0, 256, (12, 16, 3), np.uint8)) for s in stamps]
    return {"camera/image": images, "arm/joints": joints, "cmd/twist": commands, "said": [Text(stamp=START, text="go")]}


def test_lerobot_frame_holds_an_image_with_the_newest_other_messages(tmp_path: Path) -> None:
    streams_of = arm()

    path = of_robot(tmp_path / "a.mcap", streams_of)
    done = exported(path, export_lerobot, tmp_path / "set", action="cmd/twist", task="pick it up")

    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    table = pq.read_table(tmp_path / "set" / info["data_path"].format(episode_chunk=0, episode_index=0))
    rows = table.to_pylist()
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v2.1", 10, 5)
    assert [row["stamp"] for row in rows] == [m.stamp for m in streams_of["camera/image"][1:]]
    assert [row["observation.state"] for row in rows] == [[5.0 * k, -5.0 * k] for k in range(1, 6)]
    assert [row["action"][0] for row in rows] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert np.allclose([row["timestamp"] for row in rows], np.arange(5) / 10)
    picture = rows[0]["observation.images.camera.image"]["bytes"]
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.array_equal(decoded, streams_of["camera/image"][1].data)
    assert set(info["features"]) == set(table.column_names)
    assert info["features"]["observation.images.camera.image"]["shape"] == [12, 16, 3]
    assert done.left_out == {"said": "it holds no numbers of which each message has as many"}


def test_messages_in_no_lerobot_frame_are_counted_as_lost(tmp_path: Path) -> None:
    streams_of = arm()
    for k in (4, 5):  # a pause of an hour in front of them
        moved = streams_of["camera/image"][k]
        streams_of["camera/image"][k] = moved.replace(stamp=moved.stamp + 3600 * SECOND)
    done = exported(of_robot(tmp_path / "a.mcap", streams_of), export_lerobot, tmp_path / "set")

    lost = {name: sum(losses.values()) for name, losses in done.lost.items()}
    frames = done.written["camera/image"]
    assert frames == 5  # the first image came before the first command
    assert done.written["arm/joints"] == 4
    assert done.written["arm/joints"] + lost["arm/joints"] == len(streams_of["arm/joints"])
    assert done.written["cmd/twist"] + lost["cmd/twist"] == len(streams_of["cmd/twist"])
    assert [number for what, number in done.lost["camera/image"].items() if "pauses" in what] == [1]


def test_two_cameras_of_one_name_in_lerobot_are_refused_by_their_names(tmp_path: Path) -> None:
    streams = arm()
    both = {"camera/image": streams["camera/image"], "camera.image": streams["camera/image"]}
    with pytest.raises(RecordingError, match=r"camera\.image and camera/image are both"):
        exported(of_robot(tmp_path / "a.mcap", both), export_lerobot, tmp_path / "set")


def test_the_statistics_of_a_lerobot_dataset_are_those_of_its_columns(tmp_path: Path) -> None:
    exported(of_robot(tmp_path / "a.mcap", arm()), export_lerobot, tmp_path / "set")

    table = pq.read_table(tmp_path / "set/data/chunk-000/episode_000000.parquet")
    states = np.array(table["observation.state"].to_pylist())
    stats = json.loads((tmp_path / "set/meta/episodes_stats.jsonl").read_text())["stats"]
    found = stats["observation.state"]
    for name in ("min", "max", "mean", "std"):
        assert np.allclose(found[name], getattr(states, name)(0))
    assert found["count"] == [len(states)]
    assert np.array(stats["observation.images.camera.image"]["mean"]).shape == (3, 1, 1)
    assert json.loads((tmp_path / "set/meta/episodes.jsonl").read_text())["length"] == len(states)
    assert b"huggingface" in table.schema.metadata


def test_a_lerobot_dataset_of_format_3_locates_its_episodes(tmp_path: Path) -> None:
    """What LeRobot 3 reads, in its order: info, tasks by their text, episodes, then the rows of an episode."""
    pd = pytest.importorskip("pandas")
    path = of_robot(tmp_path / "a.mcap", arm())
    done = exported(path, export_lerobot, tmp_path / "set", layout=Layout30(), action="cmd/twist", task="pick it up")
    exported(path, export_lerobot, tmp_path / "old", action="cmd/twist", task="pick it up")

    meta = tmp_path / "set/meta"
    info = json.loads((meta / "info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v3.0", 1, 5)
    assert (info["chunks_size"], info["data_files_size_in_mb"], info["video_path"]) == (1000, 100, None)
    assert not {"total_chunks", "total_videos"} & info.keys()
    assert all("/" not in name for name in info["features"])
    tasks = pd.read_parquet(meta / "tasks.parquet")
    assert (tasks.index.name, int(tasks.loc["pick it up"].task_index)) == ("task", 0)
    (episode,) = pq.read_table(meta / "episodes/chunk-000/file-000.parquet").to_pylist()
    assert (episode["episode_index"], episode["tasks"], episode["length"]) == (0, ["pick it up"], 5)
    assert (episode["meta/episodes/chunk_index"], episode["meta/episodes/file_index"]) == (0, 0)
    place = {"chunk_index": episode["data/chunk_index"], "file_index": episode["data/file_index"]}
    table = pq.read_table(tmp_path / "set" / info["data_path"].format(**place))
    rows = table.slice(episode["dataset_from_index"], episode["dataset_to_index"] - episode["dataset_from_index"])
    assert rows["index"].to_pylist() == [0, 1, 2, 3, 4]
    assert set(rows["episode_index"].to_pylist()) == {0}
    assert table.equals(pq.read_table(tmp_path / "old/data/chunk-000/episode_000000.parquet"))
    stats = json.loads((meta / "stats.json").read_text())
    assert stats == json.loads((tmp_path / "old/meta/episodes_stats.jsonl").read_text())["stats"]
    for key, values in stats.items():
        assert {name: episode[f"stats/{key}/{name}"] for name in values} == values
    assert sorted(Path(file).relative_to(tmp_path / "set").as_posix() for file in done.files) == [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    ]


def test_stream_of_varying_size_is_named_with_the_option_to_omit_it(tmp_path: Path) -> None:
    streams = arm()
    longer = JointState(stamp=START + 11 * SECOND // 10, names=("a", "b", "c"), positions=np.zeros(3))
    late = Image(stamp=START + 12 * SECOND // 10, frame="c", data=np.zeros((12, 16, 3), np.uint8))
    streams["arm/joints"].append(longer)
    streams["camera/image"].append(late)
    path = of_robot(tmp_path / "a.mcap", streams)

    with pytest.raises(RecordingError, match=r"--without robot1/arm/joints$"):
        exported(path, export_lerobot, tmp_path / "set", action="cmd/twist")


def test_a_single_number_is_a_number_in_the_table_as_lerobot_takes_it(tmp_path: Path) -> None:
    streams = arm()
    streams["arm/joints"] = [Number(stamp=m.stamp, value=float(k)) for k, m in enumerate(streams["camera/image"])]
    exported(
        of_robot(tmp_path / "a.mcap", streams), export_lerobot, tmp_path / "set", layout=Layout30(), action="cmd/twist"
    )

    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    features = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert table.schema.field("observation.state").type == "float"
    assert features["observation.state"] == {"dtype": "float32", "_type": "Value"}
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["features"]["observation.state"]["shape"] == [1]


def test_the_command_writes_format_3(tmp_path: Path) -> None:
    path = of_robot(tmp_path / "a.mcap", arm())
    words = ["convert", str(path), str(tmp_path / "set"), "--quiet", "--to", "lerobot-v3", "--action", "cmd/twist"]
    shown = CliRunner().invoke(app, words)
    assert shown.exit_code == 0, shown.output
    assert json.loads((tmp_path / "set/meta/info.json").read_text())["codebase_version"] == "v3.0"


def test_a_dataset_without_images_or_with_another_action_is_refused(tmp_path: Path) -> None:
    path = of_robot(tmp_path / "a.mcap", {"said": [Text(stamp=START, text="go")]})
    with pytest.raises(RecordingError, match="takes images"):
        exported(path, export_lerobot, tmp_path / "set")
    with pytest.raises(RecordingError, match="no stream 'go'"):
        exported(of_robot(tmp_path / "b.mcap", arm()), export_lerobot, tmp_path / "set", action="go")


def drive() -> dict[str, list[Message]]:
    """A camera and a LiDAR whose scans come 5 ms later, and where the camera is."""
    rng = np.random.default_rng(0)
    K = np.array([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])
    R = np.array([0.5, -0.5, 0.5, -0.5])
    images = [
        Image(stamp=START + k * SECOND // 10, frame="c", data=rng.integers(0, 256, (12, 16, 3), np.uint8))
        for k in range(4)
    ]
    scans = [
        PointCloud(
            stamp=START + 5_000_000 + k * SECOND // 10,
            frame="velodyne",
            points=rng.normal(size=(20, 3)).astype(np.float32),
            intensities=rng.uniform(size=20).astype(np.float32),
        )
        for k in range(5)  # the last one has no image
    ]
    placed = Transforms(
        stamp=0, frames=("velodyne",), child_frames=("c",), translations=np.array([[0.1, 0.2, 0.3]]), rotations=R[None]
    )
    info = CameraInfo(stamp=0, frame="c", width=16, height=12, K=K)
    return {"camera/image": images, "lidar/points": scans, "camera/info": [info], "tf": [placed]}


def test_a_kitti_raw_drive_is_read_back_by_its_reader(tmp_path: Path) -> None:
    streams = drive()
    done = exported(of_robot(tmp_path / "a.mcap", streams, ("camera/info", "tf")), export_kitti_raw, tmp_path / "out")

    folder = tmp_path / "out/2023_11_14/2023_11_14_drive_0001_sync"
    dataset = KittiRaw(path=str(folder))
    dataset.setup()
    static, steps = dataset.static_outputs(), list(dataset.stream())
    assert len(steps) == 4
    for step, image, scan in zip(steps, streams["camera/image"], streams["lidar/points"], strict=False):
        assert step["points"].stamp == scan.stamp
        assert np.array_equal(step["points"].points, scan.points)
        assert np.array_equal(step["points"].intensities, scan.intensities)
        assert np.array_equal(step["image"].data, image.data)
    placed = static["extrinsics"]
    assert np.allclose(placed.translations, [[0.1, 0.2, 0.3]])
    assert np.allclose(np.abs(placed.rotations), 0.5)
    assert np.allclose(static["image_info"].K[0, 0], 50.0)
    assert not done.left_out


def test_files_missing_from_a_kitti_raw_drive_are_reported(tmp_path: Path) -> None:
    streams = drive()
    del streams["camera/info"], streams["tf"]
    done = exported(of_robot(tmp_path / "a.mcap", streams), export_kitti_raw, tmp_path / "out")

    assert set(done.left_out) == {"calib_cam_to_cam.txt", "calib_velo_to_cam.txt"}
    times = tmp_path / "out/2023_11_14/2023_11_14_drive_0001_sync/image_02/timestamps.txt"
    assert len(times.read_text().splitlines()) == 4


def stereo(path: Path, missing: set[tuple[str, int]]) -> Path:
    streams: dict[str, list[Message]] = {"left": [], "right": [], "pose": []}
    for k in range(5):
        stamp = (k + 1) * SECOND // 10
        for name in ("left", "right"):
            if (name, k) not in missing:
                streams[name].append(Image(stamp=stamp, frame=name, data=np.full((4, 6), 10 * k, np.uint8)))
        place = [k if k != 2 else float("nan"), 0, 0]
        streams["pose"].append(Pose(stamp=stamp + 1000, frame="map", position=place, orientation=[0, 0, 0, 1]))
    return of_robot(path, streams)


def test_an_image_without_one_of_the_other_camera_is_left_out_and_counted(tmp_path: Path) -> None:
    done = exported(
        stereo(tmp_path / "a.mcap", {("left", 1), ("right", 2), ("right", 4)}), export_kitti, tmp_path / "kitti"
    )

    assert len(list((tmp_path / "kitti" / "image_0").iterdir())) == 2
    assert [cv2.imread(str(tmp_path / "kitti" / "image_1" / f"00000{k}.png"), 0)[0, 0] for k in (0, 1)] == [0, 30]
    assert np.loadtxt(tmp_path / "kitti" / "times.txt").tolist() == pytest.approx([0.0, 0.3])
    assert np.loadtxt(tmp_path / "kitti" / "poses.txt")[:, 3].tolist() == [0, 3]
    lost = "an image without one of the other camera of its stamp, left out"
    assert (done.lost["left"][lost], done.lost["right"][lost]) == (2, 1)


def test_a_pose_that_is_none_is_left_out_of_a_trajectory_and_counted(tmp_path: Path) -> None:
    done = exported(stereo(tmp_path / "a.mcap", set()), export_tum, tmp_path / "tum", ["robot1/pose"])

    assert np.loadtxt(tmp_path / "tum" / "groundtruth.txt")[:, 1].tolist() == [0, 1, 3, 4]
    assert done.lost == {"pose": {"a pose that is not finite, left out": 1}}


def test_frames_are_paired_without_holding_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Colour is 5 ms behind depth; images in memory are those near a frame that still waits for others."""
    held, streams = [], {"color": list[Message](), "depth": list[Message]()}
    for k in range(60):
        stamp = (k + 1) * SECOND // 30
        pixels = np.full((4, 6, 3), k, np.uint8)
        streams["color"].append(Image(stamp=stamp + 5_000_000, frame="c", data=pixels))
        streams["depth"].append(DepthImage(stamp=stamp, frame="c", data=np.ones((4, 6), np.float32)))
    nearest = frames.nearest
    monkeypatch.setattr(frames, "nearest", lambda found, stamp: (held.append(len(found)), nearest(found, stamp))[1])

    exported(of_robot(tmp_path / "a.mcap", streams), export_7scenes, tmp_path / "scenes")

    assert max(held) <= 3
    assert [cv2.imread(str(tmp_path / "scenes" / f"frame-{k:06d}.color.png"))[0, 0, 0] for k in (0, 59)] == [0, 59]


def lens(frame: str, focal: float, distortion: list[float] | None = None) -> CameraInfo:
    K = np.array([[focal, 0, 8], [0, focal, 6], [0, 0, 1.0]])
    model = "none" if distortion is None else "plumb_bob"
    found = None if distortion is None else np.array(distortion)
    return CameraInfo(stamp=START, frame=frame, width=16, height=12, K=K, distortion_model=model, distortion=found)


def test_a_kitti_camera_gets_its_own_calibration_and_the_rest_is_reported(tmp_path: Path) -> None:
    mounted = Transforms.from_matrix(np.eye(4), stamp=START, frame="c", child_frame="d")
    streams = {
        "a/info": [lens("d", 100)],
        "b/info": [lens("c", 50, [0.1, 0, 0, 0, 0])],
        "camera/image": arm()["camera/image"],
        "mounting": [mounted],
    }
    done = Exported()
    with ExportSource(of_robot(tmp_path / "a.mcap", streams, static=("a/info", "b/info", "mounting"))) as source:
        DATASETS["kitti"](source, tmp_path / "set", done)
        tell_untaken(source, "kitti", done)

    assert (tmp_path / "set/calib.txt").read_text().startswith("P0: 5.0")
    assert done.left_out.keys() == {"a/info", "mounting"}
    assert done.lost["b/info"] == {"the distortion of its lens (plumb_bob)": 1}
