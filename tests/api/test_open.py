"""`dataflow.open`: streams by name, parts by time, messages when they are asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from analysed import MS, START, imu
from made_parts import cut
from mcap.writer import Writer

import dataflow
from dataflow.api.names import StreamNameError
from dataflow.messages import Imu, Message
from dataflow.recording import RecordingError
from dataflow.recording.streams import reader


@pytest.mark.parametrize("name", ["r1/robot/imu", "/r1/robot/imu", "robot/imu", "imu", "**/imu", "robot/im$*"])
def test_a_stream_is_found_by_full_and_short_names_and_patterns(recording: dataflow.RecordedStreams, name: str) -> None:
    assert recording[name].name == "r1/robot/imu"
    assert name in recording


def test_a_name_that_means_nothing_is_an_error_with_the_nearest_one(recording: dataflow.RecordedStreams) -> None:
    with pytest.raises(StreamNameError, match=r"no stream 'robot/imo': did you mean 'robot/imu'\?"):
        recording["robot/imo"]
    with pytest.raises(KeyError):
        recording["gyro"]
    assert "gyro" not in recording


def test_ambiguous_stream_name_error_lists_the_streams(recording: dataflow.RecordedStreams) -> None:
    with pytest.raises(StreamNameError, match=r"means 2 streams: r1/camera/image, r1/camera/info; select\(\)"):
        recording["camera/*"]

    assert list(recording.select("camera/*", "imu")) == ["r1/camera/image", "r1/camera/info", "r1/robot/imu"]


def test_messages_come_by_place_and_in_order(recording: dataflow.RecordedStreams) -> None:
    stream = recording["imu"]

    assert len(stream) == 11
    assert stream[0] == imu(0)
    assert stream[-1] == imu(10)
    assert list(stream) == [imu(i) for i in range(11)]
    assert [m.stamp for m in stream[8:]] == [START + 10 * MS * i for i in (8, 9, 10)]
    assert stream[::5][1] == imu(5)
    assert stream[3:][1:3][0] == imu(4)
    with pytest.raises(IndexError, match="message 11 of r1/robot/imu, which has 11"):
        stream[11]


def test_nothing_is_decoded_before_it_is_asked_for(
    recording: dataflow.RecordedStreams, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    decoded = reader.decoded

    def noting(path: Path, name: str, channel: Any, raw: reader.RawMessage, extra: Any) -> Message:
        read.append(raw.log_time)
        return decoded(path, name, channel, raw, extra)

    monkeypatch.setattr(reader, "decoded", noting)
    part = recording.between(0.02, 0.08)["imu"][2:]
    assert len(part) == 5
    assert part.stamps.tolist() == [START + 10 * MS * i for i in range(4, 9)]
    assert repr(part) == "<r1/robot/imu: 5 × Imu>"
    assert read == []

    assert part[1].stamp == START + 50 * MS
    assert read == [START + 50 * MS]


def test_a_part_by_time_holds_both_ends_and_the_static_streams(recording: dataflow.RecordedStreams) -> None:
    part = recording.between(0.02, 0.05)

    assert part["imu"].seconds.round(6).tolist() == [0.02, 0.03, 0.04, 0.05]
    assert len(part["camera/info"]) == 1
    assert (part.start, part.end) == (START + 20 * MS, START + 50 * MS)
    assert part.duration == pytest.approx(0.03)
    assert part.between(0.04, 9)["imu"].seconds.round(6).tolist() == [0.04, 0.05]
    assert recording.within(last=START)["imu"][-1] == imu(0)
    assert [item.stream for item in part.select("imu", "image").messages()] == [
        "r1/robot/imu", "r1/robot/imu", "r1/robot/imu", "r1/camera/image", "r1/robot/imu",
    ]  # fmt: skip


def test_the_message_at_a_moment_is_the_newest_until_then(recording: dataflow.RecordedStreams) -> None:
    stream = recording["image"]

    assert stream.at(0.042) == stream[0]
    assert stream.at(0.043) == stream[1]
    assert stream.at(0.0029) is None


def test_a_file_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="that is a folder"):
        dataflow.open(tmp_path)
    (tmp_path / "text.mcap").write_text("no recording")
    with pytest.raises(RecordingError, match="is not an MCAP file"):
        dataflow.open(tmp_path / "text.mcap")


def test_a_recording_whose_writer_was_killed_opens_up_to_its_last_chunk(path: Path) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: whole.rindex(b"\x89MCAP0\r\n") - 200])

    with dataflow.open(path) as recording:
        assert len(recording["imu"]) == 11
        assert recording["imu"][10] == imu(10)


def test_reading_a_closed_recording_is_refused(path: Path) -> None:
    with dataflow.open(path) as recording:
        stream = recording["imu"]
        assert stream[0] == imu(0)
    with pytest.raises(RecordingError, match="closed"):
        stream[1]


def test_streams_of_unknown_types_are_listed_and_say_why_they_cannot_be_read(tmp_path: Path) -> None:
    file = tmp_path / "foreign.mcap"
    with file.open("wb") as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema("acme/Thing", "ros2msg", b"int32 a")
        channel = writer.register_channel("/thing", "cdr", schema)
        writer.add_message(channel, log_time=5, publish_time=5, data=b"\0")
        writer.finish()

    with dataflow.open(file) as recording:
        assert repr(recording["thing"]) == "</thing: 1 × acme/Thing>"
        assert "acme/Thing" in recording._repr_html_()
        with pytest.raises(RecordingError, match="cdr messages of acme/Thing"):
            recording["thing"].columns()
        assert [item.stream for item in recording.messages()] == []


def test_html_names_streams_with_rates_and_the_empty_ones(recording: dataflow.RecordedStreams) -> None:
    text = recording._repr_html_()

    assert '<td style="text-align:left">robot/imu</td>' in text
    assert ">100.00<" in text
    assert "without messages: robot/battery" in text
    assert "rad/s" in recording["imu"]._repr_html_()
    assert np.array_equal(recording["imu"].between(0.05).stamps, recording["imu"].stamps[5:])
    assert isinstance(recording["imu"][0], Imu)


def test_seconds_of_a_part_begin_where_it_was_cut(path: Path, tmp_path: Path) -> None:
    with dataflow.open(cut(path, tmp_path / "part.mcap", 0.025, None)) as part:
        assert part.start == START + 25 * MS
        assert [m.stamp for m in part.between(0.0, 0.016)["imu"]] == [START + 30 * MS, START + 40 * MS]
