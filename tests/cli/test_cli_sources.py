"""Every command that opens a file of another program takes its damage in one way."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

import dataflow as api
from dataflow.recording import Recording, RecordingError, diff

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
COUNT = 120
GRAPH = """\
graph: g
operators:
  body: {use: "operators.sources:RecordedPose"}
  scores: {use: "operators.evaluation:TrajectoryMetrics", inputs: {estimate: body/pose, ground_truth: body/pose}}
"""


def poses(
    path: Path,
    compression: CompressionType = CompressionType.ZSTD,
    *,
    summary: bool = True,
    bad: int | None = None,
    text: bytes = b'{"timestamp": {"sec": 17',
) -> Path:
    """120 poses of another program, as Foxglove's JSON, and 120 messages of a schema that nobody knows, in 10 chunks
    or so. `bad`: the number of a pose that is `text` instead."""
    plain = {} if summary else {"index_types": IndexType.NONE, "repeat_channels": False, "use_statistics": False}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096, compression=compression, **plain)
        writer.start(library="other")
        known, unknown = (writer.register_schema(n, "jsonschema", b"{}") for n in ("foxglove.PoseInFrame", "other"))
        pose, other = (writer.register_channel(n, "json", kind) for n, kind in (("/pose", known), ("/any", unknown)))
        for i in range(COUNT):
            time = START + i * SECOND // 100
            place = {"position": {"x": i, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
            stamp = {"sec": time // SECOND, "nsec": time % SECOND}
            data = json.dumps({"timestamp": stamp, "frame_id": "map", "pose": place}).encode()
            writer.add_message(pose, time, text if i == bad else data, time, i)
            writer.add_message(other, time, b'{"number": %d, "text": "%s"}' % (i, b"abcdefgh" * 10), time, i)
        writer.finish()
    return path


def changed(path: Path, change: Callable[[bytearray], bytes | None]) -> Path:
    data = bytearray(path.read_bytes())
    path.write_bytes(change(data) or data)
    return path


def third_chunk(path: Path) -> tuple[int, int]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)[2]
    return chunk.chunk_start_offset, chunk.chunk_length


def flipped(path: Path, at: int) -> Path:
    def flip(data: bytearray) -> None:
        data[at] ^= 0xFF

    return changed(path, flip)


def damaged_chunk(path: Path) -> Path:
    start, length = third_chunk(poses(path))
    return flipped(path, start + length * 2 // 3)


def wrong_checksum(path: Path) -> Path:
    start, _ = third_chunk(poses(path, CompressionType.NONE))
    return flipped(path, start + 9 + 8 + 8 + 8)


def unknown_compression(path: Path) -> Path:
    start, _ = third_chunk(poses(path))
    at = start + 9 + 8 + 8 + 8 + 4 + 4

    def rename(data: bytearray) -> None:
        assert data[at : at + 4] == b"zstd"
        data[at : at + 4] = b"zzzz"

    return changed(path, rename)


def torn(path: Path) -> Path:
    return changed(poses(path), lambda data: bytes(data[: len(data) * 6 // 10]))


def without_footer(path: Path) -> Path:
    return changed(poses(path), lambda data: bytes(data[:-37]))


def wrong_summary(path: Path) -> Path:
    return flipped(poses(path), poses(path).stat().st_size - 8 - 4)


def without_summary(path: Path) -> Path:
    return poses(path, summary=False)


def bad_message(path: Path) -> Path:
    return poses(path, bad=50)


def empty(path: Path) -> Path:
    path.write_bytes(b"")
    return path


def compressed(path: Path) -> Path:
    packed = path.with_name(f"{path.name}.zst")
    packed.write_bytes(zstandard.compress(poses(path).read_bytes()))
    return packed


def folder_of_it(path: Path) -> Path:
    folder = path.parent / "folder"
    folder.mkdir()
    poses(folder / "bag_0.mcap")
    return folder


def empty_folder(path: Path) -> Path:
    path.mkdir()
    return path


BAG = (
    ("info", "{}"),
    ("lint", "{}"),
    ("convert", "{}", "{}.out.mcap", "--to", "mcap"),
    ("convert", "{}", "{}.csv", "--to", "csv"),
    ("convert", "{}", "{}.ros2", "--to", "ros2"),
    ("view", "{}", "--to", "{}.rrd"),
    ("replay", "{}", "--graph", "{g}", "--one-process", "-q"),
)
"""Commands that open bags of all kinds."""
FILE = (
    ("diff", "{}", "{}"),
    ("cut", "{}", "--duration", "1s", "-o", "{}.cut.mcap"),
    ("filter", "{}", "--stream", "/pose", "-o", "{}.filter.mcap"),
    ("split", "{}", "--every", "500ms", "-o", "{}.split"),
    ("merge", "{}", "{o}", "--prefix", "{o}=o/", "-o", "{}.merged.mcap"),
    ("recover", "{}", "-o", "{}.saved.mcap"),
)
"""Commands that open MCAP files."""
CHUNKS = (damaged_chunk, wrong_checksum, unknown_compression)
"""What shows when chunks are read."""


@pytest.mark.parametrize(
    ("make", "code", "file_code", "said"),
    [
        (damaged_chunk, 1, 1, "does not decompress"),
        (wrong_checksum, 1, 1, "fails its checksum"),
        (unknown_compression, 1, 1, "compressed with 'zzzz'"),
        (torn, 1, 1, "no proper end"),
        (without_footer, 1, 1, "no proper end"),
        (wrong_summary, 0, 0, "fails its checksum"),
        (without_summary, 0, 0, ""),
        (empty, 2, 2, "it is empty"),
        (empty_folder, 2, 2, "is a folder"),
        (compressed, 0, 2, ""),
        (folder_of_it, 0, 2, ""),
    ],
)
@pytest.mark.long
def test_every_command_takes_damage_in_one_way(
    dataflow, tmp_path: Path, make: Callable[[Path], Path], code: int, file_code: int, said: str
) -> None:
    """0: nothing is missing; 1: what is there is used, what is missing is said; 2: nothing can be used. `info`
    describes a file, and does not read its chunks; `diff` compares what both hold; `lint` finds any damage."""
    path, graph, other = make(tmp_path / "a.mcap"), tmp_path / "g.yaml", poses(tmp_path / "other.mcap")
    graph.write_text(GRAPH)
    for words, expected in (*((words, code) for words in BAG), *((words, file_code) for words in FILE)):
        exits = {
            "info": 0 if expected == 1 else expected,
            "lint": 1 if make is wrong_summary else expected,
            "diff": 0 if make in (torn, without_footer) else expected,
            "merge": 0 if make is empty else expected,
        }
        told = dataflow(*(w.format(path, g=graph, o=other) for w in words), code=exits.get(words[0], expected))
        if words[0] != "merge" and (
            words[0] != "info" or make not in (damaged_chunk, wrong_checksum, unknown_compression)
        ):
            assert said in " ".join((told.stdout + told.stderr).split()), words


@pytest.mark.parametrize(
    "words",
    [
        "convert FILE OUT.mcap --to mcap --clock log --json",
        "convert FILE OUT --to csv --clock log --json",
        "convert FILE OUT --to ros2 --stream /pose --json",
        "lint FILE --json",
        "cut FILE -o OUT.mcap --from 0 --json",
        "filter FILE -o OUT.mcap --stream /pose --json",
    ],
)
def test_damaged_chunk_is_passed_over_and_counted_unless_strict(dataflow, tmp_path: Path, words: str) -> None:
    path = damaged_chunk(tmp_path / "a.mcap")
    places = {"FILE": path} | {name: tmp_path / name for name in ("OUT", "OUT.mcap", "OTHER", "OTHER.mcap")}

    done = dataflow(*(places.get(word, word) for word in words.split()), code=1)

    assert "12 messages lost to damage" in done.stdout + done.stderr
    assert "chunk 2 at byte" in done.stdout
    if words.startswith("convert"):
        strict = (places.get(word, word) for word in words.replace("OUT", "OTHER").split())
        assert "chunk 2 at byte" in dataflow(*strict, "--strict", code=2).stderr


@pytest.mark.parametrize("make", [damaged_chunk, bad_message])
def test_messages_that_cannot_be_read_are_passed_over_and_counted(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    path = make(tmp_path / "a.mcap")
    with Recording(path) as recording, Recording(poses(tmp_path / "whole.mcap")) as whole:
        read = [recorded.message.position[0] for recorded in recording.messages(["/pose"])]
        raw = [record.sequence for record in recording.raw(["/any"])]
        unread = recording.unread
        report = {stream.stream: stream for stream in diff(recording, whole).streams}

    lost = COUNT - len(read)
    assert 0 < lost < 30
    assert set(read) < set(range(COUNT))
    assert unread["/pose"].count == lost
    assert report["/pose"].unread_in_a == report["/pose"].missing_in_a == lost
    assert report["/pose"].differing == 0
    assert report["/any"].missing_in_a == COUNT - len(raw)
    assert (len(raw) < COUNT) == (make is damaged_chunk)
    with api.open(path) as opened:
        stream = opened["/pose"]
        with pytest.warns(UserWarning, match=f"/pose: {lost} message"):
            assert len(stream) == len(read)
        assert [message.position[0] for message in stream] == read
        assert len(stream.stamps) == len(read)


def test_streams_unreadable_in_both_recordings_are_different(tmp_path: Path) -> None:
    path = damaged_chunk(tmp_path / "a.mcap")
    with Recording(path) as a, Recording(path) as b:
        report = diff(a, b)
    assert [stream.outcome for stream in report.streams] == ["different", "different"]
    assert not any(stream.missing_in_a or stream.differing for stream in report.streams)


@pytest.mark.parametrize("text", [b"", b"null", b"[]", b"7", b'{"pose": 5}', b"\xff", b"[" * 9000])
def test_a_first_message_that_cannot_be_read_costs_itself_alone(tmp_path: Path, text: bytes) -> None:
    with Recording(poses(tmp_path / "a.mcap", bad=0, text=text)) as recording:
        assert len(list(recording.messages(["/pose"]))) == COUNT - 1
        assert recording.unread["/pose"].count == 1


def test_damage_in_a_recording_of_ours_stays_an_error(dataflow, recorded, tmp_path: Path) -> None:
    path = tmp_path / "own.mcap"
    path.write_bytes(recorded[0].read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    for chunk in summary.chunk_indexes:
        flipped(path, chunk.chunk_start_offset + chunk.chunk_length * 2 // 3)

    assert "is damaged" in dataflow("diff", path, recorded[0], code=2).stderr
    with pytest.raises(RecordingError, match="is damaged"), Recording(path) as recording:
        list(recording.messages())


def test_a_compressed_file_is_opened_whatever_its_name(dataflow, tmp_path: Path) -> None:
    packed = tmp_path / "poses.backup"
    packed.write_bytes(zstandard.compress(poses(tmp_path / "a.mcap").read_bytes()))
    told = json.loads(dataflow("info", packed, "--json").stdout)
    assert told["messages"] == 2 * COUNT
    packed.write_bytes(zstandard.compress(b"<html>moved</html>"))
    assert "a page of the web" in dataflow("info", packed, code=2).stderr


def test_fewer_messages_than_statistics_count_fail_the_command(dataflow, tmp_path: Path) -> None:
    path = poses(tmp_path / "a.mcap")

    def promise(data: bytearray) -> None:
        at = data.rfind(struct.pack("<HQ", 1, COUNT))
        data[at : at + 10] = struct.pack("<HQ", 1, COUNT + 10)
        data[-12:-8] = bytes(4)  # no checksum of the summary

    changed(path, promise)
    told = dataflow("convert", path, tmp_path / "o.mcap", "--to", "mcap", code=1).stderr
    assert "statistics count 130 messages of /pose, 120 are there" in " ".join(told.split())
    dataflow("cut", path, "--duration", "10ms", "-o", tmp_path / "c.mcap", code=1)
    assert "120 are there" in " ".join(dataflow("info", path).stdout.split())


def test_a_definition_that_is_broken_costs_its_own_topic(dataflow, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="other")
        for name, text in (("/bad", b"garbage def {{{"), ("/good", b"string data")):
            schema = writer.register_schema(f"std_msgs/{'Odd' if name == '/bad' else 'String'}", "ros1msg", text)
            channel = writer.register_channel(name, "ros1", schema)
            for k in range(3):
                data = b"\xff\xff\xff\x7f" if k == 1 else struct.pack("<I", 2) + b"hi"
                writer.add_message(channel, START + k * SECOND, data, START + k * SECOND, k)
        writer.finish()

    told = json.loads(dataflow("convert", path, tmp_path / "bag", "--to", "ros2", "--json").stdout)

    assert told["written"] == {"/good": 2}
    assert "definition of std_msgs/msg/Odd is broken" in told["left_out"]["/bad"]
    assert list(told["lost"]["/good"].values()) == [1]


def test_replay_of_a_damaged_file_counts_losses_in_text_and_json(dataflow, tmp_path: Path) -> None:
    path, graph = damaged_chunk(tmp_path / "a.mcap"), tmp_path / "g.yaml"
    graph.write_text(GRAPH)
    words = ("replay", path, "--graph", graph, "--one-process")

    told = dataflow(*words, "-q", code=1).stderr
    notes = json.loads(dataflow(*words, "--json", code=1).stdout)["notes"]

    assert "topic /pose: 12 messages lost to damage" in " ".join(told.split())
    assert any("topic /pose: 12 messages lost to damage" in note for note in notes)


def test_files_of_a_folder_that_are_no_parts_of_one_are_not_read_as_one(dataflow, tmp_path: Path) -> None:
    for name in ("kitchen", "street"):
        poses(tmp_path / f"{name}.mcap")
    assert "no parts of one (kitchen.mcap, street.mcap): name one" in " ".join(
        dataflow("info", tmp_path, code=2).stderr.split()
    )
    (tmp_path / "street.mcap").rename(tmp_path / "kitchen_1.mcap")
    (tmp_path / "kitchen.mcap").rename(tmp_path / "kitchen_0.mcap")
    dataflow("info", tmp_path)


def test_python_api_warns_of_damaged_files(tmp_path: Path) -> None:
    graph = tmp_path / "g.yaml"
    graph.write_text(GRAPH)
    with pytest.warns(UserWarning, match="no proper end"), api.open(torn(tmp_path / "a.mcap")):
        pass
    path = damaged_chunk(tmp_path / "b.mcap")
    with pytest.warns(UserWarning, match="does not decompress"):
        api.replay(path, graph=graph)
