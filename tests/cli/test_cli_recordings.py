"""`info`, `diff` and `view` of recordings: ours, other people's, torn ones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dataflow.messages import Number
from dataflow.recording import RecordingWriter
from dataflow.recording.mcap.attachments import Attachment


@pytest.fixture(scope="module")
def longer(dataflow, small: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with more messages."""
    path = tmp_path_factory.mktemp("longer") / "longer.mcap"
    dataflow("run", small, "--record", path, "--one-process", "--set", "count=35", "-q")
    return path


def test_info_shows_streams_and_their_graph(dataflow, recorded) -> None:
    path, _ = recorded
    told = dataflow("info", path).stdout

    assert "small, namespace test" in told
    assert "complete" in told
    row = next(line.split() for line in told.splitlines() if line.strip().startswith("left/fast"))
    assert row[:4] == ["left/fast", "FeatureVector", "30", "100.00"]
    assert "eclipse-zenoh" not in told
    assert "eclipse-zenoh" in dataflow("info", path, "--metadata").stdout


def test_info_prints_the_digests_of_the_run_as_json(dataflow, recorded) -> None:
    path, report = recorded

    described = json.loads(dataflow("info", path, "--digests", "--json").stdout)

    assert described["digests"] == {name: stream["digest"] for name, stream in report["streams"].items()}


def test_info_lists_attachments_and_metadata(dataflow, tmp_path: Path) -> None:
    path = tmp_path / "carrying.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        writer.add_stream("test/number", Number)
        writer.add_attachment(Attachment("calibration.yaml", "text/yaml", 1, 2, b"fx: 500"))
        writer.add_metadata("trip", {"driver": "somebody"})

    told = dataflow("info", path).stdout

    assert "calibration.yaml, text/yaml, 7 B" in told
    assert "trip (--metadata prints it)" in told
    described = json.loads(dataflow("info", path, "--json").stdout)
    assert described["attachments"] == [{"name": "calibration.yaml", "media_type": "text/yaml", "bytes": 7}]
    assert described["metadata"]["trip"] == {"driver": "somebody"}


def test_info_fits_80_columns_with_whole_stream_names(dataflow, recorded, monkeypatch) -> None:
    monkeypatch.setattr("dataflow.cli.commands.recordings.out.width", 80)
    lines = dataflow("info", recorded[0]).stdout.splitlines()

    assert max(map(len, lines)) <= 80
    assert any("left/constant" in line for line in lines)


def test_info_reads_other_peoples_files(dataflow, data_dir: Path) -> None:
    told = dataflow("info", data_dir / "bags" / "nav2_turtlebot.mcap").stdout

    assert "/odom" in told
    assert "2,639" in told


def test_a_torn_recording_is_described_as_torn(dataflow, recorded, tmp_path: Path) -> None:
    torn = tmp_path / "torn.mcap"
    whole = recorded[0].read_bytes()
    torn.write_bytes(whole[: len(whole) // 2])

    assert "it is being written, or its writer died" in dataflow("info", torn).stdout


def test_diff_finds_the_first_difference_and_exits_1(dataflow, recorded, longer: Path) -> None:
    path, _ = recorded

    told = dataflow("diff", path, longer, code=1).stdout
    assert "different" in told
    assert "left/fast at 1.300000000s, (message): message 30 is only in B" in told
    report = json.loads(dataflow("diff", path, longer, "--json", code=1).stdout)
    assert report["same"] is False


def test_diff_of_chosen_streams(dataflow, recorded, longer: Path) -> None:
    path, _ = recorded

    assert "the same: 1 stream" in dataflow("diff", path, longer, "--stream", "left/constant").stdout
    assert "did you mean 'left/fast'?" in dataflow("diff", path, longer, "--stream", "left/fats", code=2).stderr
    assert "0 or more" in dataflow("diff", path, longer, "--tolerance", "-1", code=2).stderr
    assert f"did you mean {path}?" in dataflow("diff", path, path.parent / "rum.mcap", code=2).stderr


def test_a_recording_is_saved_for_the_viewer(dataflow, recorded, tmp_path: Path) -> None:
    saved = tmp_path / "run.rrd"

    told = dataflow("view", recorded[0], "--to", saved, "--stream", "left/*", "--start", "0.1")

    assert (
        f"wrote {saved} (25 messages" in told.stdout
    )  # 20 fast and 4 slow ones from 0.1 to 0.29 s, and the static one
    assert saved.read_bytes()[:4] == b"RRF2"
    assert "replace it with --overwrite" in dataflow("view", recorded[0], "--to", saved, code=2).stderr


def test_a_recording_that_nothing_can_be_drawn_of_is_refused(dataflow, data_dir: Path, tmp_path: Path) -> None:
    foreign = data_dir / "bags" / "ros2_cdr_test.mcap"

    told = dataflow("view", foreign, "--to", tmp_path / "x.rrd", code=2)

    assert "holds no stream that can be drawn" in told.stderr


def test_info_names_streams_without_a_message_in_one_line(dataflow, repository: Path) -> None:
    told = dataflow("info", repository / "recordings" / "demo.mcap").stdout

    table, _, silent = told.partition("without messages: ")
    assert "robot/imu " in table
    assert "robot/radar_scan" not in table
    assert "robot/fix, robot/image, robot/landmark_map" in " ".join(silent.split())
