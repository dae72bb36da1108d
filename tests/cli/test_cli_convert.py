"""Every format and option of `dataflow convert` once, and what each command says of a source that is not whole."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from made_bags import ROS2, SECOND, header, imus, ros, transform, write_ros2, xyz, xyzw
from typer import Context
from typer.main import get_command

from dataflow.cli.commands.convert import Format, convert
from dataflow.cli.main import app
from dataflow.recording import Recording

START = 1_700_000_000 * SECOND
STAMPS = [START + i * SECOND // 10 for i in range(12)]
LATE = SECOND // 500
"""By which the log is behind the headers."""
K = np.array([20.0, 0, 4, 0, 20, 3, 0, 0, 1])


def picture(stamp: int, encoding: str, pixels: np.ndarray, frame: str) -> Any:
    height, width = pixels.shape[:2]
    sizes = {"width": width, "height": height, "step": pixels.nbytes // height, "encoding": encoding}
    return ros("sensor_msgs/Image", header=header(stamp, frame), data=pixels.reshape(-1).view(np.uint8), **sizes)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Colour, depth, calibrations, poses, inertial readings, clouds and transforms of one robot."""
    rows: list[Any] = []
    fields = [ros("sensor_msgs/PointField", name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate("xyz")]
    for stamp in STAMPS:
        color, depth = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 2000, np.uint16)
        here = ros("geometry_msgs/Pose", position=xyz(1, 2, 3, "Point"), orientation=xyzw(0, 0, 0, 1))
        points = np.ones((5, 3), np.float32)
        layout = {"width": 5, "height": 1, "point_step": 12, "row_step": 60, "fields": fields}
        cloud = ros("sensor_msgs/PointCloud2", header=header(stamp, "lidar"), data=points.view(np.uint8).reshape(-1),
                    **layout)  # fmt: skip
        rows += [
            ("/color", stamp, picture(stamp, "rgb8", color, "camera")),
            ("/depth", stamp, picture(stamp, "16UC1", depth, "camera")),
            ("/info", stamp, ros("sensor_msgs/CameraInfo", header=header(stamp, "camera"), width=8, height=6, k=K)),
            ("/pose", stamp, ros("geometry_msgs/PoseStamped", header=header(stamp, "map"), pose=here)),
            ("/points", stamp, cloud),
            ("/imu", stamp, ros("sensor_msgs/Imu", header=header(stamp, "imu"), linear_acceleration=xyz(0, 0, 9.8))),
        ]
    rows.append(("/tf_static", START, ros("tf2_msgs/TFMessage", transforms=[transform(START, "lidar", "camera")])))
    rows = [(topic, stamp + LATE, message) for topic, stamp, message in rows]
    return write_ros2(tmp_path_factory.mktemp("bags") / "drive", rows)


@pytest.fixture(scope="module")
def odd(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive with what commands have to be asked about: an image without pixels, and a cloud of 64 bits."""
    from mcap.reader import make_reader

    rows: list[Any] = []
    with (drive / "drive.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            rows.append((channel.topic, message.log_time, ROS2.deserialize_cdr(message.data, schema.name)))
    end = STAMPS[-1] + LATE
    rows.append(("/color", end, picture(STAMPS[-1] + 1, "rgb8", np.zeros((6, 8, 3), np.uint8), "camera")))
    rows[-1][2].data = np.zeros(3, np.uint8)
    fields = [ros("sensor_msgs/PointField", name=n, offset=8 * k, datatype=8, count=1) for k, n in enumerate("xyz")]
    layout = {"width": 1, "height": 1, "point_step": 24, "row_step": 24, "fields": fields}
    far = np.array([5e6 + 0.123, 4e5, 10.25]).view(np.uint8)
    rows.append(("/far", end, ros("sensor_msgs/PointCloud2", header=header(STAMPS[-1], "utm"), data=far, **layout)))
    return write_ros2(tmp_path_factory.mktemp("bags") / "odd", rows)


SUFFIXES = {"mcap": ".mcap", "foxglove": ".mcap", "rrd": ".rrd"}
NEEDS = {"parquet": "pyarrow", "lerobot": "pyarrow", "lerobot-v3": "pyarrow"}


@pytest.mark.parametrize("own", [False, True], ids=["bag", "recording"])
@pytest.mark.parametrize("format_", get_args(Format))
def test_every_format_is_written_from_the_command_line(
    dataflow, drive: Path, tmp_path: Path, format_: str, own: bool
) -> None:
    if format_ in NEEDS:
        pytest.importorskip(NEEDS[format_])
    source = drive
    if own:
        source = tmp_path / "own.mcap"
        dataflow("convert", drive, source, "--to", "mcap")
    target = tmp_path / f"out{SUFFIXES.get(format_, '')}"

    told = json.loads(dataflow("convert", source, target, "--to", format_, "--json").stdout)

    assert target.exists()
    assert told["files"]
    assert all(Path(file).exists() for file in told["files"])
    assert set(told["source"]) == {"notes", "missing", "repaired", "unread", "lost", "static", "doubted"}


CSV = ("OUT", "--to", "csv")
OPTIONS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "--out": (CSV, ("--to", "csv", "--out", "OTHER")),
    "--to": (CSV, ("OUT", "--to", "7scenes")),
    "--stream": (CSV, (*CSV, "--stream", "/imu")),
    "--without": (CSV, (*CSV, "--without", "/p*")),
    "--start": (CSV, (*CSV, "--start", "0.5")),
    "--end": (CSV, (*CSV, "--end", "0.5")),
    "--clock": (CSV, (*CSV, "--clock", "log")),
    "--action": (("OUT", "--to", "lerobot"), ("OUT", "--to", "lerobot", "--action", "/pose")),
    "--task": (("OUT", "--to", "lerobot"), ("OUT", "--to", "lerobot", "--task", "look")),
    "--depth": (("OUT", "--to", "tum"), ("OUT", "--to", "tum", "--depth", "/depth=5000")),
    "--lossy": (("OUT.mcap", "--to", "foxglove"), ("OUT.mcap", "--to", "foxglove", "--lossy")),
    "--strict": (CSV, (*CSV, "--strict")),
    "--overwrite": (("THERE.mcap", "--to", "mcap"), ("THERE.mcap", "--to", "mcap", "--overwrite")),
    "--json": (("OUT", "--to", "euroc"), ("OUT", "--to", "euroc", "--json")),
}
"""By option: a command without it, and one with it, which does something else."""


def outcome(
    dataflow: Any, source: Path, folder: Path, words: tuple[str, ...], code: int
) -> tuple[str, dict[str, bytes]]:
    """Standard output without the folder's name, and what each file of the folder holds."""
    folder.mkdir()
    (folder / "THERE.mcap").write_bytes(b"")
    places = [str(folder / word) if word.partition(".")[0] in ("OUT", "OTHER", "THERE") else word for word in words]
    done = dataflow("convert", source, *places, code=code)
    files = {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}
    return done.stdout.replace(str(folder), ""), files


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_does_something(dataflow, odd: Path, tmp_path: Path, option: str) -> None:
    if "lerobot" in OPTIONS[option][0]:
        pytest.importorskip("pyarrow")

    words = OPTIONS[option]
    without = outcome(dataflow, odd, tmp_path / "a", words[0], {"--lossy": 2, "--overwrite": 2}.get(option, 0))
    given = outcome(dataflow, odd, tmp_path / "b", words[1], {"--strict": 2}.get(option, 0))

    assert given[0] != without[0] if option == "--json" else given[1] != without[1]


@pytest.mark.parametrize("format_", get_args(Format))
def test_a_span_and_the_choice_of_streams_count_in_every_format(
    dataflow, drive: Path, tmp_path: Path, format_: str
) -> None:
    if format_ in NEEDS:
        pytest.importorskip(NEEDS[format_])

    def messages(*words: str) -> int:
        target = tmp_path / f"out{len(list(tmp_path.iterdir()))}{SUFFIXES.get(format_, '')}"
        told = json.loads(dataflow("convert", drive, target, "--to", format_, *words, "--json").stdout)
        return int(told["messages"] if format_ == "rrd" else sum(told["written"].values()))

    whole = messages()
    assert 0 < messages("--start", "0.45") < whole
    assert 0 < messages("--end", "0.45") < whole
    if format_ != "kitti-raw":
        assert 0 < messages("--without", "/pose", "--without", "/imu") < whole or "lerobot" in format_


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--start", "100"), "ends 1.10 s after its first message"),
        (("--start", "1", "--end", "0.5"), "--end 0.5 must be greater than --start 1"),
        (("--start", "-1"), "expected seconds from the recording's first message"),
        (("--end", "nan"), "expected seconds from the recording's first message"),
    ],
)
@pytest.mark.parametrize("format_", ["mcap", "ros2", "csv", "tum", "lerobot"])
def test_a_span_without_a_message_is_refused(
    dataflow, drive: Path, tmp_path: Path, format_: str, words: tuple[str, ...], told: str
) -> None:
    target = tmp_path / f"out{SUFFIXES.get(format_, '')}"

    assert told in dataflow("convert", drive, target, "--to", format_, *words, code=2).stderr
    assert not target.exists()


@pytest.mark.parametrize("format_", ["mcap", "rrd"])
@pytest.mark.parametrize("words", [("--clock", "log"), ("--strict",)])
def test_options_of_bags_are_refused_for_a_recording(
    dataflow, drive: Path, tmp_path: Path, format_: str, words: tuple[str, ...]
) -> None:
    dataflow("convert", drive, tmp_path / "own.mcap", "--to", "mcap")

    told = dataflow("convert", tmp_path / "own.mcap", tmp_path / f"o.{format_}", "--to", format_, *words, code=2).stderr

    assert f"{words[0]}: " in told
    assert "of bags alone" in told


def test_strict_counts_for_a_viewer_file_too(dataflow, odd: Path, tmp_path: Path) -> None:
    said = dataflow("convert", odd, tmp_path / "a.rrd").stderr
    refused = dataflow("convert", odd, tmp_path / "b.rrd", "--strict", code=2).stderr

    assert "1 message that cannot be read passed over" in said
    assert "topic '/color', message 12" in refused
    assert "1 message that cannot be read passed over" in dataflow("view", odd, "--to", tmp_path / "c.rrd").stderr


def test_every_option_of_the_help_is_among_those_tried() -> None:
    group = get_command(app)
    command = group.get_command(Context(group), "convert")
    offered = {option for p in command.params for option in p.opts if option.startswith("--") and option != "--help"}
    described = set(re.findall(r"--to ([\w-]+)", convert.__doc__ or ""))

    assert offered == {*OPTIONS, "--quiet"}  # that shows nothing where there is no terminal
    assert described == set(get_args(Format))


# --------------------------------------------------------------------------------------------- what is said


def written(path: Path, times: Iterable[int]) -> Path:
    """An MCAP of Imu messages with headers 10 ms apart and given log times."""
    with path.open("wb") as file:
        from mcap.writer import Writer

        from dataflow.interop.typestores import RosType
        from dataflow.recording.streams.codecs import SchemaText

        kind = RosType("sensor_msgs/msg/Imu", "cdr", SchemaText("sensor_msgs/msg/Imu", "", b"")).as_ros2()
        writer = Writer(file, chunk_size=4000)
        writer.start(profile="ros2", library="test")
        channel = writer.register_channel("/imu", "cdr", writer.register_schema(kind.name, kind.encoding, kind.data))
        from made_bags import ROS2

        stamps = list(times)
        rows = imus([START + k * SECOND // 100 for k in range(len(stamps))])
        for time, (_, _, message) in zip(stamps, rows, strict=True):
            writer.add_message(channel, time, bytes(ROS2.serialize_cdr(message, kind.name)), time)
        writer.finish()
    return path


def test_recording_without_readable_message_is_refused_with_reason(dataflow, tmp_path: Path) -> None:
    short = written(tmp_path / "short.mcap", (START + k * SECOND // 100 for k in range(50)))
    short.write_bytes(short.read_bytes()[:100])

    told = dataflow("convert", short, tmp_path / "o.mcap", "--to", "mcap", code=2).stderr

    assert "holds no message that can be read" in told
    assert "dataflow recover" in told
    assert not (tmp_path / "o.mcap").exists()


def test_fewer_messages_than_promised_fail_and_are_reported(dataflow, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "bag", imus(STAMPS), "sqlite3")
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("delete from messages where id > 4")
    database.close()

    told = dataflow("convert", folder, tmp_path / "o.mcap", "--to", "mcap", code=1)
    as_json = dataflow("convert", folder, tmp_path / "p.mcap", "--to", "mcap", "--json", code=1).stdout

    assert "12 messages are promised, 4 are there" in told.stderr
    assert json.loads(as_json)["source"]["missing"]
    assert "12 messages are promised" in dataflow("lint", folder, code=1).stdout
    assert "12 messages are promised" in dataflow("info", folder).stdout
    with Recording(tmp_path / "o.mcap") as recording:
        assert recording.streams["imu"].count == 4


def test_repairs_are_reported_and_in_the_metadata(dataflow, tmp_path: Path) -> None:
    rows = [("/imu", s, ros("sensor_msgs/Imu", header=header(STAMPS[i // 2]))) for i, s in enumerate(STAMPS)]
    bag = write_ros2(tmp_path / "bag", rows)

    told = dataflow("convert", bag, tmp_path / "o.mcap", "--to", "mcap").stderr

    assert "imu: 6 messages recorded twice, once left out" in told
    assert '"repeated": 6' in dataflow("info", tmp_path / "o.mcap", "--metadata").stdout


def test_depth_that_a_dataset_cannot_hold_is_counted_and_never_wraps(dataflow, tmp_path: Path) -> None:
    import cv2

    depth = np.full((6, 8), 2.0, np.float32)
    depth[0], depth[1], depth[2, 0] = -1.0, 20.0, np.nan
    rows: list[Any] = [("/depth", s, picture(s, "32FC1", depth, "camera")) for s in STAMPS[:2]]
    rows += [("/color", s, picture(s, "rgb8", np.zeros((6, 8, 3), np.uint8), "camera")) for s in STAMPS[:2]]
    bag = write_ros2(tmp_path / "bag", sorted(rows, key=lambda row: row[1]))

    told = dataflow("convert", bag, tmp_path / "tum", "--to", "tum").stderr

    written = cv2.imread(str(next((tmp_path / "tum" / "depth").iterdir())), cv2.IMREAD_UNCHANGED)
    assert sorted(set(written.reshape(-1).tolist())) == [0, 10_000]
    assert "negative depth (pixels), written as no return (16)" in told
    assert "depth beyond 13.1 m (pixels), written as no return (16)" in told


def test_narrowing_is_refused_until_it_is_asked_for(dataflow, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    rows = [("/warm", s, picture(s, "mono16", np.full((6, 8), 7000, np.uint16), "camera")) for s in STAMPS]
    bag = write_ros2(tmp_path / "bag", rows)

    refused = dataflow("convert", bag, tmp_path / "l", "--to", "lerobot", code=2).stderr
    dataflow("convert", bag, tmp_path / "l", "--to", "lerobot", "--lossy")

    assert "16 bits, and LeRobot's images have 8; --lossy writes it all the same" in refused


def test_the_types_of_messages_are_listed_and_described(dataflow) -> None:
    assert "Odometry" in dataflow("messages").stdout
    described = json.loads(dataflow("messages", "Imu", "--json").stdout)
    assert {"name": "angular_velocity", "unit": "rad/s"}.items() <= {k: described["fields"][3][k] for k in ("name", "unit")}.items()  # fmt: skip  # noqa: E501
    assert described["ros"] == ["sensor_msgs/Imu"]
    assert "there is no message type 'Odo'; there are Odometry" in dataflow("messages", "Odo", code=2).stderr


def test_depth_of_a_recording_is_in_metres(dataflow, drive: Path, tmp_path: Path) -> None:
    dataflow("convert", drive, tmp_path / "own.mcap", "--to", "mcap")

    said = dataflow("convert", tmp_path / "own.mcap", tmp_path / "o", "--to", "csv", "--depth", "depth", code=2).stderr

    assert "its depth is in metres" in said


def test_log_times_before_1970_are_written_as_that_moment(dataflow, tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", [0, 5, 2**63 + 4, 2**64 - 1])
    dataflow("convert", path, tmp_path / "bag", "--to", "ros2")
    assert json.loads(dataflow("info", tmp_path / "bag", "--json").stdout)["messages"] == 4
