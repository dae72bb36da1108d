"""Attachments and metadata records of MCAP files through `convert`, read back by the mcap library."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.messages import Text
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.mcap.attachments import Attachment

CALIBRATION = ("calibration.yaml", "text/yaml", 7, 5, b"fx: 500")
START = 1_700_000_000_000_000_000


def foreign(path: Path, topic: str, *attachments: tuple[str, str, int, int, bytes], **metadata: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="another program")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel(topic, "cdr", schema)
        for name, media, log_time, created, data in attachments:
            writer.add_attachment(created, log_time, name, media, data)
        for k in range(3):
            writer.add_message(channel, START + k, b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00", START + k, k)
        for name, value in metadata.items():
            writer.add_metadata(name, {"value": value})
        writer.finish()
    return path


def ours(path: Path) -> Path:
    with RecordingWriter(path, metadata={"dataflow:run": {"mode": "run"}, "robot": {"value": "r1"}}) as writer:
        writer.add_stream("said/text", Text)
        writer.add_attachment(Attachment(*CALIBRATION))
        for k in range(3):
            writer.write("said/text", Text(stamp=START + k, text="a"), seq=k)
    return path


def held(path: Path) -> tuple[list[tuple[str, str, int, int, bytes]], dict[str, dict[str, str]]]:
    with path.open("rb") as file:
        reader = make_reader(file)
        found = [(a.name, a.media_type, a.log_time, a.create_time, a.data) for a in reader.iter_attachments()]
        return found, {m.name: dict(m.metadata) for m in reader.iter_metadata()}


def converted(path: Path, out: Path, to: str, *options: str) -> str:
    shown = CliRunner().invoke(app, ["convert", str(path), str(out), "--to", to, "--quiet", *options])
    assert shown.exit_code == 0, shown.output
    return shown.output


@pytest.mark.parametrize("to", ["mcap", "foxglove", "ros2"])
@pytest.mark.parametrize("make", ["foreign", "ours"])
def test_they_go_along_into_every_mcap(tmp_path: Path, to: str, make: str) -> None:
    if make == "ours":
        path = ours(tmp_path / "a.mcap")
    else:
        path = foreign(tmp_path / "a.mcap", "/said", CALIBRATION, robot="r1")
    out = tmp_path / ("bag" if to == "ros2" else "out.mcap")

    shown = converted(path, out, to)
    found, metadata = held(out / "bag_0.mcap" if to == "ros2" else out)
    assert found == [CALIBRATION]
    assert metadata["robot"] == {"value": "r1"}
    assert "dataflow:run" not in metadata
    assert "1 attachment, 1 metadata record" in shown
    assert ("metadata of the run" in shown) == (make == "ours")
    if to == "ros2":
        with AnyReader([out]) as reader:
            assert reader.message_count == 3


def test_attachments_and_metadata_survive_the_round_trip_through_ros(tmp_path: Path) -> None:
    path = ours(tmp_path / "a.mcap")
    converted(path, tmp_path / "bag", "ros2")
    converted(tmp_path / "bag", tmp_path / "back.mcap", "mcap")

    found, metadata = held(tmp_path / "back.mcap")
    assert found == [CALIBRATION]
    assert metadata["robot"] == {"value": "r1"}


def test_names_that_a_recording_gives_a_meaning_to_get_the_files_in_front(tmp_path: Path) -> None:
    path = foreign(tmp_path / "a.mcap", "/said", machine="mill", digests="none")
    converted(path, tmp_path / "out.mcap", "mcap")

    with Recording(tmp_path / "out.mcap") as recording:
        assert recording.metadata["a/machine"] == {"value": "mill"}
        assert recording.metadata["a/digests"] == {"value": "none"}
        assert "machine" not in recording.metadata


def test_equal_attachments_of_a_split_bag_are_taken_once_and_different_ones_kept(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    foreign(folder / "bag_0.mcap", "/said", CALIBRATION, robot="r1", rosbag2="first")
    foreign(folder / "bag_1.mcap", "/said", CALIBRATION, ("calibration.yaml", "text/yaml", 9, 9, b""), robot="r2")

    shown = converted(folder, tmp_path / "out", "ros2")
    found, metadata = held(tmp_path / "out" / "out_0.mcap")
    assert [a[0] for a in found] == ["calibration.yaml", "bag_1/calibration.yaml"]
    assert metadata == {"robot": {"value": "r1"}, "bag_1/robot": {"value": "r2"}}
    assert "metadata rosbag2" in shown


@pytest.mark.parametrize("to", ["csv", "rrd"])
def test_formats_without_attachments_report_those_left_out(tmp_path: Path, to: str) -> None:
    path = ours(tmp_path / "a.mcap")

    shown = converted(path, tmp_path / ("out" if to == "csv" else "out.rrd"), to)
    assert f"attachment calibration.yaml: {to} has no place for it" in " ".join(shown.split())
    assert f"metadata robot: {to} has no place for it" in " ".join(shown.split())
