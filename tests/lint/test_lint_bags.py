"""Bags are looked at as they are: with the timestamps of their headers, in the order of recording."""

from __future__ import annotations

import json
from pathlib import Path

from made_bags import SECOND, Row, header, ros, transform, write_ros2
from mcap.writer import Writer
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.interop.opening import open_bag
from dataflow.lint.bags import BagInput
from dataflow.lint.checks import lint

BEGIN = 1_700_000_000 * SECOND
TENTH = SECOND // 10


def bag(folder: Path) -> Path:
    """An IMU at 10 Hz with a gap of a second, a repeated and a backward timestamp; and texts without a header."""
    stamps = [BEGIN + k * TENTH for k in range(40) if not 20 <= k < 29]
    stamps[5] = stamps[4]
    stamps[10] = stamps[8] + 1
    rows = [
        ("/imu", BEGIN + k * SECOND, ros("sensor_msgs/Imu", header=header(stamp, "imu")))
        for k, stamp in enumerate(stamps)
    ]
    rows += [("/text", BEGIN + k * SECOND, ros("std_msgs/String", data="x")) for k in range(9)]
    return write_ros2(folder / "bag", rows)


def test_timestamps_are_taken_from_headers_else_from_the_recording(tmp_path: Path) -> None:
    opened = open_bag(bag(tmp_path))
    data = BagInput(opened)
    assert data.stamps("/imu")[:6].tolist() == [BEGIN + k * TENTH for k in (0, 1, 2, 3, 4, 4)]
    assert data.stamps("/text").tolist() == [BEGIN + k * SECOND for k in range(9)]
    assert [message.stamp for message in data.messages("/imu")][:2] == [BEGIN, BEGIN + TENTH]
    opened.close()


def test_planted_faults_of_a_bag_are_named(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["lint", str(bag(tmp_path)), "--json"])
    assert told.exit_code == 1, told.stderr
    found = {f["check"]: f for f in json.loads(told.stdout)["findings"] if f["stream"] == "/imu"}
    assert found["duplicate"]["values"] == {"messages": 1}
    assert found["backward"]["values"]["messages"] == 1
    assert abs(found["gap"]["values"]["longest_s"] - 1.0) < 0.01


def told(folder: Path, rows: list[Row], *, declared: tuple[str, ...] = ()) -> list[tuple[str, str, str]]:
    """(check, stream, text) of what is found in a bag."""
    opened = open_bag(write_ros2(folder / "bag", rows, declared=declared))
    report = lint(BagInput(opened))
    opened.close()
    return [(finding.check, finding.stream, finding.text) for finding in report.findings]


def test_headers_without_a_time_and_topics_without_a_message_are_named(tmp_path: Path) -> None:
    rows = [("/imu", BEGIN + k * TENTH, ros("sensor_msgs/Imu", header=header(0, "imu"))) for k in range(20)]

    found = told(tmp_path, rows, declared=("/camera",))

    assert ("empty", "/camera", "it is declared, and holds no message") in found
    (text,) = [text for check, _, text in found if check == "unstamped"]
    assert text.startswith("20 of 20 headers carry no time")


def test_two_parents_in_one_message_are_an_error(tmp_path: Path) -> None:
    stamps = [BEGIN + k * TENTH for k in range(9)]
    both = {stamp: [transform(stamp, parent, "base") for parent in ("a", "b")] for stamp in stamps}
    rows = [("/tf", stamp, ros("tf2_msgs/TFMessage", transforms=both[stamp])) for stamp in stamps]

    found = told(tmp_path, rows)

    assert ("frames", "/tf", "frame 'base' has 2 parents: 'a' (/tf), 'b' (/tf)") in found


def test_a_message_that_is_not_json_is_a_finding(tmp_path: Path) -> None:
    file = tmp_path / "poses.mcap"
    with file.open("wb") as opened:
        writer = Writer(opened)
        writer.start()
        channel = writer.register_channel("/pose", "json", writer.register_schema("foxglove.PoseInFrame", "", b""))
        place = {"position": {"x": 1, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
        for k in range(5):
            sent = {"timestamp": {"sec": k + 1, "nsec": 0}, "frame_id": "map", "pose": place}
            writer.add_message(channel, k * SECOND, b"{" if k == 3 else json.dumps(sent).encode(), 0)
        writer.finish()

    told = CliRunner().invoke(app, ["lint", str(file), "--json"])

    [found] = [f for f in json.loads(told.stdout)["findings"] if f["check"] == "unreadable"]
    assert found["text"].startswith("1 messages cannot be read, the first: not JSON")
