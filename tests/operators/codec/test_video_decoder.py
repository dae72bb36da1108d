"""The operator that decodes video: its images, its words about losses, and the same images however it is run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clip_source import messages
from made_video import PERIOD, clip, decoded

from dataflow.editing.part import Part, write_part
from dataflow.editing.split import split
from dataflow.graph import load_graph
from dataflow.messages import CompressedVideo, Image, Level
from dataflow.recording import Recording
from dataflow.recording.streams.copying import Origin
from dataflow.supervision.run import replay, run
from dataflow.testing import play
from dataflow.verification.verify import verify
from dataflow.video.decoder import is_key
from operators.codec import VideoDecoder

FORMATS = pytest.mark.parametrize("format_", ["h264", "h265"])
GRAPH = """
graph: video
namespace: test
operators:
  camera: {{use: clip_source:ClipSource, params: {{format: {format}, lost: {lost}}}}}
  decoder: {{use: operators.codec:VideoDecoder, inputs: {{video: camera/video}}}}
record: {{snapshots: 200ms}}
"""
WITHIN = 1_000_000_000 + 12 * PERIOD
"""The stamp of the packet in the middle of a group."""


@pytest.fixture(params=[("h264", []), ("h265", [10, 11])], ids=["h264", "h265, packets lost"])
def recorded(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    graph = tmp_path / "graph.yaml"
    graph.write_text(GRAPH.format(format=request.param[0], lost=request.param[1]))
    run(load_graph(graph), placement="one_process", record=tmp_path / "run.mcap")
    return tmp_path / "run.mcap"


def images(path: Path, decoder: str = "decoder") -> dict[int, bytes]:
    with Recording(path) as recording:
        return {m.message.stamp: m.message.digest() for m in recording.messages([f"test/{decoder}/image"])}


@FORMATS
def test_every_packet_becomes_its_image(format_: str) -> None:
    played = play(VideoDecoder(), {"video": messages(format_)})
    expected = [
        Image(stamp=m.stamp, frame="cam", data=pixels)
        for m, pixels in zip(messages(format_), decoded(format_, clip(format_)), strict=True)
    ]
    assert played["image"] == expected
    assert [m.messages for m in played["status"]] == [("decoding",)]


def test_lost_pictures_are_marked_until_the_next_key_frame() -> None:
    sent = messages("h264")
    del sent[10]
    played = play(VideoDecoder(), {"video": sent})
    lost = [m.stamp for m in played["status"] if m.levels[0] == Level.WARN]
    assert lost == [1_000_000_000 + k * PERIOD for k in range(11, 16)]
    assert [m.stamp for m in played["image"]] == [m.stamp for m in sent if m.stamp not in lost]
    assert {m.messages[0] for m in played["status"] if m.stamp in lost} == {
        "frame 3 follows frame 1: those between them are lost"
    }
    assert played["status"][-1].stamp == 1_000_000_000 + 16 * PERIOD
    assert dict(zip(played["status"][-1].keys, played["status"][-1].values, strict=True)) == {
        "decoded": "11",
        "lost": "5",
    }


def test_after_a_jump_of_the_clock_decoding_begins_with_a_key_frame() -> None:
    decoder = VideoDecoder()
    decoder.setup()
    sent = messages("h264")
    for message in sent[:12]:
        assert "image" in decoder.process(message)
    decoder.on_reset("video")  # the next number fits, and the picture does not
    assert decoder.process(sent[4])["status"].messages == ("its parameter sets (SPS, PPS) have not come",)
    assert "image" in decoder.process(sent[8])
    decoder.close()


def test_a_stream_with_b_frames_is_refused_by_its_stamp() -> None:
    decoder = VideoDecoder()
    decoder.setup()
    packet = np.frombuffer(clip("h264", options="bframes=2:b-adapt=0:rc-lookahead=5")[0], np.uint8)
    with pytest.raises(ValueError, match=r"CompressedVideo at stamp 7 cannot be decoded: .*encode it without B-frames"):
        decoder.process(CompressedVideo(stamp=7, frame="cam", format="h264", data=packet))


@pytest.mark.long
def test_the_images_are_the_same_in_every_placement_and_verify(recorded: Path, tmp_path: Path) -> None:
    assert len(images(recorded)) in (24, 18)
    replay(recorded, placement="process_each", record=tmp_path / "again.mcap")
    assert images(tmp_path / "again.mcap") == images(recorded)
    assert verify(recorded).identical


@pytest.mark.long
def test_replay_from_the_middle_decodes_the_same_images(recorded: Path, tmp_path: Path) -> None:
    replay(recorded, placement="one_process", record=tmp_path / "later.mcap", start=(WITHIN - 10**9) * 1e-9)
    whole = images(recorded)
    assert images(tmp_path / "later.mcap") == {stamp: digest for stamp, digest in whole.items() if stamp >= WITHIN}


@pytest.mark.long
def test_a_part_begins_with_a_key_frame_and_gives_the_same_images(recorded: Path, tmp_path: Path) -> None:
    part, fresh = tmp_path / "part.mcap", tmp_path / "fresh.yaml"
    with Origin(recorded) as origin:
        done = write_part(origin, Part(start=WITHIN), part)
    assert done.notes == ["it begins 0.160 s earlier, with a key frame of its video"]
    report = verify(part)
    assert {v.verdict for v in report.operators} == {"identical"}
    fresh.write_text(GRAPH.format(format="h264", lost=[]).replace("decoder:", "another:"))
    replay(part, graph=load_graph(fresh), placement="one_process", record=tmp_path / "again.mcap")
    expected = {stamp: digest for stamp, digest in images(recorded).items() if stamp >= WITHIN - 4 * PERIOD}
    assert images(tmp_path / "again.mcap", "another") == expected


TWO = """
graph: two
namespace: test
operators:
  one: {use: clip_source:ClipSource}
  other: {use: clip_source:ClipSource, params: {later: 5}}
  decoder: {use: operators.codec:VideoDecoder, inputs: {video: other/video}}
record: {snapshots: 80ms}
"""
"""Key frames lie at 0, 8 and 16 frames after the first second in `one`, at 5, 13 and 21 in `other`."""
CAMERAS = ("test/one/video", "test/other/video")


@pytest.fixture
def two(tmp_path: Path) -> Path:
    (tmp_path / "two.yaml").write_text(TWO)
    run(load_graph(tmp_path / "two.yaml"), placement="one_process", record=tmp_path / "two.mcap")
    return tmp_path / "two.mcap"


def packets(path: Path, stream: str) -> list[int]:
    """The numbers of the packets, counted in frames from the first second on."""
    with Recording(path) as recording:
        return [(m.message.stamp - 10**9) // PERIOD for m in recording.messages([stream])]


def test_each_camera_of_a_split_part_begins_with_its_key_frame(two: Path, tmp_path: Path) -> None:
    with Origin(two) as origin:  # without firing records no part holds what firings took
        write_part(origin, Part(bare=True), tmp_path / "bare.mcap")
    with Origin(tmp_path / "bare.mcap") as origin:
        parts = [Path(part.path) for part in split(origin, tmp_path / "bare", every=14 * PERIOD)]
    assert [packets(part, CAMERAS[0]) for part in parts] == [[*range(8)], [*range(8, 16)], [*range(16, 24)]]
    assert [packets(part, CAMERAS[1]) for part in parts] == [[*range(5, 13)], [*range(13, 21)], [*range(21, 29)]]


@pytest.mark.long
def test_split_parts_of_two_cameras_verify_and_are_the_whole(two: Path, tmp_path: Path) -> None:
    with Origin(two) as origin:
        parts = [Path(part.path) for part in split(origin, tmp_path / "parts", every=14 * PERIOD)]
    for part in parts:
        assert {v.verdict for v in verify(part).operators} == {"identical"}
    assert verify(tmp_path / "parts").identical
    for camera in CAMERAS:
        assert packets(tmp_path / "parts", camera) == packets(two, camera)
    assert images(tmp_path / "parts") == images(two)


@pytest.mark.long
def test_split_parts_begin_with_key_frames_and_are_the_whole(recorded: Path, tmp_path: Path) -> None:
    with Origin(recorded) as origin:
        parts = list(split(origin, tmp_path, every=10 * PERIOD))
    found = []
    for part in parts:
        assert part.span is not None
        with Recording(Path(part.path)) as recording:  # before its span stand packets that a repeated firing took
            packets = [m.message for m in recording.messages(["test/camera/video"], part.span[0])]
        assert is_key(packets[0].format, packets[0].data.tobytes())
        found += [packet.stamp for packet in packets]
    assert len(parts) == 3
    with Recording(recorded) as recording:
        assert found == [m.message.stamp for m in recording.messages(["test/camera/video"])]
