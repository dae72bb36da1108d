"""Bags of others on the command line: viewed, converted, replayed through a graph by name; streams by pattern."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from foreign_mcap import foreign_mcap
from made_bags import SECOND, header, ros, write_ros1, write_ros2, xyz, xyzw

START = 1_700_000_000 * SECOND


def poses(topics: tuple[str, ...]) -> list[tuple[str, int, object]]:
    rows: list[tuple[str, int, object]] = []
    for i in range(20):
        stamp = START + i * SECOND // 10
        place = ros("geometry_msgs/Pose", position=xyz(0.1 * i, 0, 0, "Point"), orientation=xyzw(0, 0, 0, 1))
        rows += [(t, stamp, ros("geometry_msgs/PoseStamped", header=header(stamp, "map"), pose=place)) for t in topics]
    return rows


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trajectories of one robot."""
    return write_ros2(tmp_path_factory.mktemp("bags") / "drive", poses(("/estimate", "/truth")))


def test_a_bag_is_drawn_as_a_recording_is(dataflow, bag: Path, tmp_path: Path) -> None:
    dataflow("view", bag, "--to", tmp_path / "a.rrd", "--without", "/truth", "--end", "1")
    told = dataflow("convert", bag, tmp_path / "b.rrd", "--json").stdout

    assert (tmp_path / "a.rrd").stat().st_size > 1000
    drawn = {"files": [str(tmp_path / "b.rrd")], "messages": 40, "not_drawn": 0}
    assert json.loads(told).items() >= drawn.items()


def test_a_ros_1_bag_is_drawn_too(dataflow, tmp_path: Path) -> None:
    from made_bags import ROS1

    text = ros("std_msgs/String", ROS1, data="hello")
    file = write_ros1(tmp_path / "old.bag", [("/said", START + k * SECOND, text) for k in range(3)])

    assert "3 messages" in dataflow("view", file, "--to", tmp_path / "old.rrd").stdout


def test_converting_to_a_dataset_takes_the_streams_left_by_without(dataflow, bag: Path, tmp_path: Path) -> None:
    assert "give one with --to: mcap, ros2, foxglove" in dataflow("convert", bag, tmp_path / "a", code=2).stderr
    refused = dataflow("convert", bag, tmp_path / "a", "--to", "tum", code=2).stderr
    assert "--without all but one of /estimate, /truth" in " ".join(refused.split())

    dataflow("convert", bag, tmp_path / "a", "--to", "tum", "--without", "/estim*")

    assert np.loadtxt(tmp_path / "a" / "groundtruth.txt").shape == (20, 8)
    assert (
        "no stream is left" in dataflow("convert", bag, tmp_path / "b", "--to", "csv", "--without", "**", code=2).stderr
    )


def test_a_graph_that_comes_with_dataflow_is_named_for_a_bag_too(dataflow, bag: Path) -> None:
    refused = dataflow("replay", bag, "--graph", "synthetic_rgbd", code=2).stderr

    assert "which topics feed the graph must be said with --map" in " ".join(refused.split())


@pytest.mark.long
def test_star_within_a_part_matches_any_characters(dataflow, recorded, tmp_path: Path) -> None:
    told = dataflow("filter", recorded[0], "--stream", "left/*st", "-o", tmp_path / "part.mcap", "--json").stdout

    assert "test/left/fast" in told
    assert "test/left/slow" not in told


@pytest.mark.parametrize("to", ["csv", "tum", "ros2"])
def test_a_conversion_that_fails_or_is_interrupted_leaves_nothing(
    dataflow, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str
) -> None:
    from dataflow.interop.export.report import Exported

    def interrupted(self: Exported, name: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Exported, "count", interrupted)
        dataflow("convert", bag, tmp_path / "out", "--to", to, "--stream", "/truth", code=130)
    assert not list(tmp_path.iterdir())

    dataflow("convert", bag, tmp_path / "out", "--to", to, "--stream", "/truth")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_recording_may_be_converted_in_its_place(dataflow, recorded, tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    file.write_bytes(recorded[0].read_bytes())

    dataflow("convert", file, file, "--to", "mcap", "--overwrite")

    assert json.loads(dataflow("info", file, "--json").stdout)["messages"] > 0


@pytest.mark.parametrize("command", ["latency", "verify", "diff"])
def test_ros_1_bag_in_place_of_a_recording_is_refused_with_the_conversion(
    dataflow, tmp_path: Path, command: str
) -> None:
    from made_bags import ROS1

    file = write_ros1(tmp_path / "old.bag", [("/said", START, ros("std_msgs/String", ROS1, data="hello"))])
    words = (command, file, file) if command == "diff" else (command, file)

    assert f"`dataflow convert {file} OUT.mcap --to mcap`" in dataflow(*words, code=2).stderr


def test_latencies_of_a_file_without_firing_records_are_refused_with_the_reason(
    dataflow, bag: Path, tmp_path: Path
) -> None:
    dataflow("convert", bag, tmp_path / "drive.mcap", "--to", "mcap")

    assert "holds no firing records" in dataflow("latency", tmp_path / "drive.mcap", code=2).stderr


def test_topics_of_bags_stay_absolute_behind_a_prefix(dataflow, bag: Path, tmp_path: Path) -> None:
    file = bag / "drive.mcap"
    other = tmp_path / "other.mcap"
    other.write_bytes(file.read_bytes())

    done = dataflow("merge", file, other, "-o", tmp_path / "both.mcap", "--prefix", f"{other}=rear/", "--json")

    assert set(json.loads(done.stdout)["streams"]) == {"/estimate", "/truth", "/rear/estimate", "/rear/truth"}


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of two cameras at 10 Hz, recorded 2 ms late, the eleventh of the left one without pixels."""
    rows: list[tuple[str, int, object]] = []
    for k in range(20):
        for topic, level in (("/left", 10), ("/right", 200)):
            stamp = START + k * SECOND // 10
            pixels = np.full(0 if topic == "/left" and k == 10 else 48, level, np.uint8)
            about = {"width": 8, "height": 6, "step": 8, "encoding": "mono8"}
            image = ros("sensor_msgs/Image", header=header(stamp, topic), data=pixels, **about)
            rows.append((topic, stamp + SECOND // 500, image))
    return write_ros2(tmp_path_factory.mktemp("film") / "film", rows)


WATCH = """graph: watch
operators:
  camera: {use: "operators.sources:RecordedCamera"}
  watch: {use: "operators.monitoring:ImageWatch", inputs: {image: camera/image}}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "stamps", "said"),
    [
        (("--map", "/left=camera/image"), [k / 10 for k in range(20) if k != 10], "1 message that cannot be read"),
        (("--map", "/right=camera/image"), [k / 10 for k in range(20)], ""),
        (("--map", "/left=camera/image", "--start", "0.95"), [1.1 + k / 10 for k in range(9)], "1 message that cannot"),
        (("--map", "/left=camera/image", "--end", "0.95"), [k / 10 for k in range(10)], ""),
        (("--map", "/right=camera/image", "--clock", "log"), [k / 10 + 0.002 for k in range(20)], "asked for"),
    ],
    ids=lambda words: " ".join(words) if isinstance(words, tuple) else "",
)
def test_options_of_a_replayed_bag_select_its_messages(
    dataflow, film: Path, tmp_path: Path, words: tuple[str, ...], stamps: list[float], said: str
) -> None:
    from dataflow.recording import Recording

    (tmp_path / "watch.yaml").write_text(WATCH)

    told = dataflow("replay", film, "--graph", tmp_path / "watch.yaml", "--record", tmp_path / "o.mcap", *words).stderr

    with Recording(tmp_path / "o.mcap") as recording:
        played = [round((m.stamp - START) / SECOND, 3) for m in recording.messages(["watch/camera/image"])]
    assert played == pytest.approx(stamps)
    assert said in told if said else "cannot be read" not in told


@pytest.mark.long
def test_a_replay_that_is_strict_ends_at_a_message_that_cannot_be_read(dataflow, film: Path, tmp_path: Path) -> None:
    (tmp_path / "watch.yaml").write_text(WATCH)
    words = ("replay", film, "--graph", tmp_path / "watch.yaml", "--map", "/left=camera/image", "--one-process")

    assert "topic '/left', message 10 at" in dataflow(*words, "--strict", code=1).stderr


def test_options_of_bags_are_refused_when_a_recording_is_replayed(dataflow, recorded) -> None:
    assert "--strict: " in dataflow("replay", recorded[0], "--strict", code=2).stderr
    assert "--clock: " in dataflow("replay", recorded[0], "--clock", "log", code=2).stderr


def test_metadata_records_and_attachments_of_others_are_shown(dataflow, tmp_path: Path) -> None:
    file = foreign_mcap(
        tmp_path / "drive.mcap",
        [("/a", 1, b"{}")],
        metadata={"vehicle": {"name": "truck 7"}},
        attachments=[("calib.txt", "text/plain", 1, 1, b"P0: 1")],
    )

    told = json.loads(dataflow("info", file, "--json").stdout)

    assert told["metadata"] == [{"name": "vehicle", "values": {"name": "truck 7"}}]
    assert told["attachments"] == 1
    assert "truck 7" not in dataflow("info", file).stdout
    assert "truck 7" in dataflow("info", file, "--metadata").stdout


def test_bag_without_metadata_records_is_reported(dataflow, tmp_path: Path) -> None:
    from made_bags import ROS1

    text = ros("std_msgs/String", ROS1, data="hello")
    file = write_ros1(tmp_path / "old.bag", [("/said", START, text)])

    assert "holds no metadata records" in dataflow("info", file, "--metadata", code=2).stderr
    assert "messages of a bag have none" in dataflow("info", file, "--digests", code=2).stderr
