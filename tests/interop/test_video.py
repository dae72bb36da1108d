"""Video of other programs becomes packets that decode; formats that are not decoded are named."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo as Proto
from google.protobuf.timestamp_pb2 import Timestamp
from made_bags import ROS2, SECOND, header, made, ros, write_ros2
from made_recordings import foreign
from made_video import PERIOD, clip, decoded

from dataflow.interop.opening import open_bag
from dataflow.interop.streams import BagStreams, MappedTopic
from dataflow.interop.topics import Reading
from dataflow.recording.streams.foxglove import file_descriptor_set
from dataflow.testing import play
from operators.codec import VideoDecoder

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    import rerun as rr

START = 5 * SECOND


def ffmpeg(number: int, data: bytes, encoding: str) -> Any:
    about = {"width": 96, "height": 64, "encoding": encoding, "pts": number, "flags": int(number % 8 == 0)}
    at, flat = header(START + number * PERIOD, "cam"), np.frombuffer(data, np.uint8)
    return ros("ffmpeg_image_transport_msgs/FFMPEGPacket", header=at, data=flat, **about)


def foxglove(number: int, data: bytes, encoding: str) -> Any:
    stamp = START + number * PERIOD
    time = made(ROS2, "builtin_interfaces/msg/Time", {"sec": stamp // SECOND, "nanosec": stamp % SECOND})
    flat = np.frombuffer(data, np.uint8)
    return ros("foxglove_msgs/CompressedVideo", timestamp=time, frame_id="cam", data=flat, format=encoding)


def compressed(number: int, data: bytes, encoding: str) -> Any:
    stamp, flat = header(START + number * PERIOD, "cam"), np.frombuffer(data, np.uint8)
    return ros("sensor_msgs/CompressedImage", header=stamp, format=encoding, data=flat)


def images_of(path: Path) -> list[np.ndarray]:
    """Decodes the one topic of a bag; its stamps are those of the frames."""
    with BagStreams(path, {"video": MappedTopic("/video", "CompressedVideo")}) as bag:
        packets = [recorded.message for recorded in bag.messages()]
    assert [m.stamp for m in packets] == [START + k * PERIOD for k in range(24)]
    assert all(m.frame == "cam" for m in packets)
    return [image.data for image in play(VideoDecoder(), {"video": packets})["image"]]


@pytest.mark.parametrize(
    ("make", "encoding", "format_"),
    [
        (ffmpeg, "libx264", "h264"),
        (ffmpeg, "hevc_nvenc", "h265"),
        (ffmpeg, "h264;yuv420p;bgr8;bgr8", "h264"),
        (foxglove, "h264", "h264"),
        (foxglove, "h265", "h265"),
        (compressed, "h264", "h264"),
    ],
)
def test_packets_of_ros_bags_decode(make: Any, encoding: str, format_: str, tmp_path: Path) -> None:
    packets = clip(format_)
    rows = [("/video", START + k * PERIOD + 999, make(k, data, encoding)) for k, data in enumerate(packets)]
    found = images_of(write_ros2(tmp_path / "bag", rows))
    assert all(map(np.array_equal, found, decoded(format_, packets)))


@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_packets_of_foxglove_files_decode(encoding: str, tmp_path: Path) -> None:
    packets = clip("h264")
    messages = []
    for k, packet in enumerate(packets):
        seconds, rest = divmod(START + k * PERIOD, SECOND)
        if encoding == "protobuf":
            at = Timestamp(seconds=seconds, nanos=rest)
            data = Proto(timestamp=at, frame_id="cam", format="h264", data=packet).SerializeToString()
        else:
            values = {"timestamp": {"sec": seconds, "nsec": rest}, "frame_id": "cam", "format": "h264"}
            data = json.dumps(values | {"data": base64.b64encode(packet).decode()}).encode()
        messages.append((START + k * PERIOD + 1, data))
    kind = ("protobuf", file_descriptor_set(Proto)) if encoding == "protobuf" else ("jsonschema", b"{}")
    foreign(tmp_path / "video.mcap", ("/video", encoding, ("foxglove.CompressedVideo", *kind), messages))
    assert all(map(np.array_equal, images_of(tmp_path / "video.mcap"), decoded("h264", packets)))


@pytest.mark.parametrize(("make", "encoding"), [(ffmpeg, "libsvtav1"), (foxglove, "av1"), (foxglove, "vp9")])
def test_other_formats_are_refused_with_a_reason(make: Any, encoding: str, tmp_path: Path) -> None:
    rows = [("/video", START + k * PERIOD, make(k, b"\x12\0\x0a\x0b", encoding)) for k in range(3)]
    bag = open_bag(write_ros2(tmp_path / "bag", rows))
    reading = Reading(bag, bag.topics["/video"])
    bag.close()
    assert not reading.playable
    assert f"'{encoding}' is not read: those known are h264 and h265" in reading.reason
    assert "AV1" in reading.reason


def rerun_file(path: Path, codec: rr.VideoCodec, packets: Sequence[bytes], **timeline: str) -> Path:
    with rr.RecordingStream("test", recording_id="test") as recording:
        recording.save(path)
        recording.log("cam/video", rr.VideoStream(codec=codec), static=True)
        for k, packet in enumerate(packets):
            stamp = START + k * PERIOD
            if timeline["of"] == "timestamp":
                recording.set_time("frame time", timestamp=np.datetime64(stamp, "ns"))
            else:
                recording.set_time("frame time", duration=np.timedelta64(stamp, "ns"))
            recording.log("cam/video", rr.VideoStream.from_fields(sample=packet))
        recording.log("cam/points", rr.Points3D([[0, 0, 1]]))
    return path


@pytest.mark.parametrize(("codec", "format_"), [("H264", "h264"), ("H265", "h265")])
@pytest.mark.parametrize("of", ["timestamp", "duration"])
def test_video_streams_of_rerun_files_decode(codec: str, format_: str, of: str, tmp_path: Path) -> None:
    packets = clip(format_)
    path = rerun_file(tmp_path / "video.rrd", codec, packets, of=of)
    with BagStreams(path, {"video": MappedTopic("/cam/video", "CompressedVideo")}) as bag:
        found = [recorded.message for recorded in bag.messages()]
        assert "/cam/video is stamped by its timeline 'frame time'" in bag.notes
    assert [m.stamp for m in found] == [START + k * PERIOD for k in range(24)]
    images = play(VideoDecoder(), {"video": found})["image"]
    assert all(np.array_equal(m.data, frame) for m, frame in zip(images, decoded(format_, packets), strict=True))


def test_a_timeline_of_numbers_gives_no_times(tmp_path: Path) -> None:
    with rr.RecordingStream("test", recording_id="numbers") as recording:
        recording.save(tmp_path / "video.rrd")
        for k, packet in enumerate(clip("h264")):
            recording.set_time("frame", sequence=k)
            recording.log("cam/video", rr.VideoStream.from_fields(sample=packet, codec="H264"))
    bag = open_bag(tmp_path / "video.rrd")
    assert bag.notes == (
        "/cam/video is stamped by its timeline 'log_time', the time of logging: it has no other timeline of times",
    )
    found = [Proto.FromString(bytes(stored.data)) for stored in bag.messages(["/cam/video"])]
    assert [each.data for each in found] == list(clip("h264"))


def test_packets_before_their_timeline_leave_all_of_them_on_another(tmp_path: Path) -> None:
    packets = clip("h264")
    with rr.RecordingStream("test", recording_id="before") as recording:
        recording.save(tmp_path / "video.rrd")
        recording.log("cam/video", rr.VideoStream.from_fields(sample=packets[0], codec="H264"))
        recording.set_time("frame time", duration=3.0)
        recording.log("cam/video", rr.VideoStream.from_fields(sample=packets[1]))
    bag = open_bag(tmp_path / "video.rrd")
    assert "timeline 'log_time'" in bag.notes[0]
    first, second = (stored.log_time for stored in bag.messages(["/cam/video"]))
    assert 0 <= second - first < 60 * SECOND


def test_video_of_no_stated_codec_is_refused_with_a_reason(tmp_path: Path) -> None:
    with rr.RecordingStream("test", recording_id="no codec") as recording:
        recording.save(tmp_path / "video.rrd")
        recording.set_time("frame time", timestamp=np.datetime64(START, "ns"))
        recording.log("cam/video", rr.VideoStream.from_fields(sample=clip("h264")[0]))
    bag = open_bag(tmp_path / "video.rrd")
    assert len(list(bag.messages(["/cam/video"]))) == 1
    assert "video of format 'unknown' is not read" in Reading(bag, bag.topics["/cam/video"]).reason


def test_the_first_of_several_recordings_is_read_and_the_others_named(tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.rrd" for name in ("one", "two")]
    for file in files:
        with rr.RecordingStream("test", recording_id=file.stem) as recording:
            recording.save(file)
            for k, packet in enumerate(clip("h264")):
                recording.set_time("frame time", timestamp=np.datetime64(START + k * PERIOD, "ns"))
                recording.log("cam/video", rr.VideoStream.from_fields(sample=packet, codec="H264"))
    merge = [sys.executable, "-m", "rerun", "rrd", "merge", *map(str, files), "-o", str(tmp_path / "both.rrd")]
    subprocess.run(merge, check=True, capture_output=True, timeout=60)
    bag = open_bag(tmp_path / "both.rrd")
    assert bag.topics["/cam/video"].count == 24
    assert bag.notes[0] == "its recording 'two' is not read: the first one is, 'one'"


def test_a_rerun_file_is_held_in_memory_once(tmp_path: Path) -> None:
    packets = np.random.default_rng(0).integers(0, 256, (100, 40_000)).astype(np.uint8)
    path = rerun_file(tmp_path / "video.rrd", rr.VideoCodec.H264, [row.tobytes() for row in packets], of="timestamp")
    tracemalloc.start()  # counts what is outside of Rerun's columns
    try:
        bag = open_bag(path)
        largest = max(len(stored.data) for stored in bag.messages(bag.topics))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert largest > packets.shape[1]
    assert peak < packets.nbytes / 2


def test_av1_of_a_rerun_file_is_refused_with_a_reason(tmp_path: Path) -> None:
    path = rerun_file(tmp_path / "video.rrd", rr.VideoCodec.AV1, [b"\x12\0\x0a\x0b"] * 3, of="timestamp")
    bag = open_bag(path)
    assert "video of format 'av1' is not read" in Reading(bag, bag.topics["/cam/video"]).reason
