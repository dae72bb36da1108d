"""The reader: order, ranges, static streams, torn, damaged and foreign files."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_recordings import foreign, noise, pose, recorded
from mcap.writer import CompressionType, IndexType

from dataflow.messages import CompressedImage, DepthImage, Image, Pose, Transforms
from dataflow.messages.digest import StreamDigest
from dataflow.recording import ForeignDecoder, Recording, RecordingError, RecordingWriter, register_decoder
from dataflow.recording.layout import DIGESTS
from dataflow.recording.mcap import cache
from dataflow.recording.mcap.chunks import Chunks
from dataflow.recording.streams.codecs import SchemaText, build
from dataflow.recording.streams.foxglove import file_descriptor_set

once = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def read(path: Path, *args: Any, **kwargs: Any) -> list[tuple[str, int]]:
    with Recording(path) as recording:
        return [(m.stream, m.stamp) for m in recording.messages(*args, **kwargs)]


streams_in_file_order = st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 20)), max_size=60).map(
    # (stream, step) pairs become (stream, stamp): each stream increases, but the file as a whole is in no order
    lambda steps: [
        (name, 1000 * (ord(name) % 2) + sum(s for n, s in steps[: i + 1] if n == name))
        for i, (name, _) in enumerate(steps)
    ]
)


@once
@given(
    rows=streams_in_file_order,
    chunk_bytes=st.sampled_from([1, 300, 10**6]),
    start=st.none() | st.integers(0, 1300),
    end=st.none() | st.integers(0, 1300),
)
def test_messages_are_merged_by_stamp_then_stream_whatever_their_order_in_the_file(
    rows: list[tuple[str, int]], chunk_bytes: int, start: int | None, end: int | None, record: Callable[..., Path]
) -> None:
    path = record([(name, pose(stamp)) for name, stamp in rows], chunk_bytes=chunk_bytes)
    expected = [
        (name, stamp)
        for stamp, name in sorted((stamp, name) for name, stamp in rows)
        if (start is None or start <= stamp) and (end is None or stamp <= end)
    ]
    assert read(path, start=start, end=end) == expected


def test_chosen_streams_come_alone_and_in_order(record: Callable[..., Path]) -> None:
    path = record([("b", pose(1)), ("a", pose(2)), ("c", pose(3)), ("a", pose(4))])
    assert read(path, ["c", "a"]) == [("a", 2), ("c", 3), ("a", 4)]
    assert read(path, []) == []
    with Recording(path) as recording, pytest.raises(RecordingError, match="no stream 'd'; it holds a, b, c"):
        list(recording.messages(["d"]))


@pytest.mark.parametrize("start", [None, 0, 15, 10**6])
def test_static_streams_come_first_whatever_the_range(start: int | None, record: Callable[..., Path]) -> None:
    rows = [("pose", pose(t)) for t in (10, 20, 30)] + [("mount", pose(25)), ("mount2", pose(0))]
    path = record(rows, static=["mount", "mount2"])
    moving = [("pose", t) for t in (10, 20, 30) if start is None or t >= start]
    assert read(path, start=start) == [("mount2", 0), ("mount", 25), *moving]
    assert read(path, ["mount"], start=start, end=1) == [("mount", 25)]


def test_a_clock_that_jumps_back_is_read_incarnation_after_incarnation(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, metadata={}) as writer:
        for name in "ab":
            writer.add_stream(name, Pose)
        for incarnation, stamps in enumerate([(100, 110), (50, 105)]):
            for seq, stamp in enumerate(stamps):
                for name in "ab":
                    writer.write(name, pose(stamp), seq=seq, incarnation=incarnation)
    assert read(path) == [(n, t) for t in (100, 110, 50, 105) for n in "ab"]


def test_stream_facts_need_no_decoding(record: Callable[..., Path]) -> None:
    images = [Image(stamp=100 * i, frame="c", data=noise(i, 10, 10, 3)) for i in range(1, 8)]
    with Recording(record([("camera/image", m) for m in images], chunk_bytes=700)) as recording:
        info = recording.streams["camera/image"]
    assert (info.count, info.first, info.last) == (7, 100, 700)
    assert (info.schema, info.encoding, info.message_type) == ("foxglove.RawImage", "protobuf", Image)
    assert 7 * 300 < info.bytes < 7 * 360
    assert not info.static
    assert not info.declared_otherwise


def test_digests_are_over_the_message_digests_in_stream_order(record: Callable[..., Path]) -> None:
    messages = [pose(i, x=i / 3) for i in range(5)]
    expected = StreamDigest()
    for message in messages:
        expected.update(message.digest())
    with Recording(record([("a", m) for m in messages])) as recording:
        assert recording.digests() == recording.metadata[DIGESTS] == {"a": expected.hexdigest()}
    with Recording(record([("a", m) for m in messages[:-1]])) as recording:
        assert recording.digests()["a"] != expected.hexdigest()


def test_chunks_that_do_not_stay_in_memory_are_read_again(
    record: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Streams written one after the other: the merge goes to and fro between distant chunks."""
    rows = [(n, Image(stamp=i, frame=n, data=noise(i, 20, 20))) for n in "abcd" for i in range(12)]
    path = record(rows, chunk_bytes=1000)
    monkeypatch.setattr(cache, "KEPT_BYTES", 2500)
    monkeypatch.setattr(cache, "MOST_BYTES", 2500)
    with Recording(path) as recording:
        got = [(m.stamp, m.stream, m.message) for m in recording.messages()]
    assert got == sorted(((m.stamp, n, m) for n, m in rows), key=lambda row: row[:2])


@pytest.fixture
def unpacked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Chunks, int]]:
    """The chunks that are decompressed, each time, with what is kept of others then held to be small."""
    found: list[tuple[Chunks, int]] = []
    unpack = Chunks._decompress

    def counted(chunks: Chunks, number: int) -> bytes:
        found.append((chunks, number))
        return unpack(chunks, number)

    monkeypatch.setattr(Chunks, "_decompress", counted)
    monkeypatch.setattr(cache, "KEPT_BYTES", 2500)
    monkeypatch.setattr(cache, "NOTED", 8)
    return found


def test_memory_for_chunks_does_not_grow_with_a_recording(
    record: Callable[..., Path], unpacked: list[tuple[Chunks, int]]
) -> None:
    path = record([("a", Image(stamp=i, frame="a", data=noise(i, 20, 20))) for i in range(100)], chunk_bytes=500)
    with Recording(path) as recording:
        for _ in range(3):
            assert len(list(recording.messages())) == 100
        (kept,) = {chunks.cache for chunks, _ in unpacked}
        assert 0 < kept.nbytes <= 2500


def test_chunks_in_use_at_a_time_stay_in_memory(
    record: Callable[..., Path], unpacked: list[tuple[Chunks, int]]
) -> None:
    """Streams written one after the other, together larger than what is kept of what is read once."""
    rows = [(n, Image(stamp=i, frame=n, data=noise(i, 20, 20))) for n in "abcdef" for i in range(60)]
    with Recording(record(rows, chunk_bytes=1000)) as recording:
        assert len(list(recording.messages())) == len(rows)
        chunks = len(set(unpacked))
    assert chunks > 60
    assert len(unpacked) < 1.2 * chunks


def test_the_parts_of_a_recording_share_the_memory_for_chunks(
    tmp_path: Path, unpacked: list[tuple[Chunks, int]]
) -> None:
    for part in range(10):
        rows = [("a", Image(stamp=i, frame="a", data=noise(i, 20, 20))) for i in range(10 * part, 10 * part + 10)]
        recorded(tmp_path / f"run_{part:03}.mcap", rows, chunk_bytes=1000)
    with Recording(tmp_path) as recording:
        assert len(list(recording.messages())) == 100
        assert len({chunks for chunks, _ in unpacked}) == 10
        (kept,) = {chunks.cache for chunks, _ in unpacked}
        assert 0 < kept.nbytes <= 2500


def test_an_empty_recording_opens(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with RecordingWriter(path, metadata={"graph": {"text": ""}}) as writer:
        writer.add_stream("a", Pose)
    with Recording(path) as recording:
        assert not recording.torn
        assert list(recording.messages()) == []
        assert (recording.streams["a"].count, recording.streams["a"].first) == (0, None)
        assert recording.metadata["graph"] == {"text": ""}


@pytest.mark.parametrize("content", [b"", b"\x89MCA", b"#ROSBAG V2.0\n" * 9, b"SQLite format 3\x00" * 9])
def test_a_file_that_is_no_mcap_is_refused_by_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.bag"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"other\.bag is not an MCAP file"):
        Recording(path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"gone\.mcap: No such file"):
        Recording(tmp_path / "gone.mcap")


@once
@given(data=st.data())
def test_a_recording_cut_anywhere_gives_a_prefix(data: st.DataObject, record: Callable[..., Path]) -> None:
    rows = [(name, pose(10 * i)) for i in range(1, 30) for name in "ab"]
    path = record(rows, chunk_bytes=1000)
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(8, len(whole) - 1))])
    with Recording(path) as recording:
        assert recording.torn
        got = [(m.stream, m.stamp, m.seq) for m in recording.messages()]
    assert got == [(n, 10 * i, i - 1) for i in range(1, 30) for n in "ab"][: len(got)]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32))
def test_damage_ends_in_an_error_that_names_the_file_and_in_no_other(seed: int, record: Callable[..., Path]) -> None:
    rng = random.Random(seed)
    written = {(n, i): pose(i, x=i) for i in range(20) for n in "ab"}
    path = record([(n, m) for (n, _), m in written.items()], chunk_bytes=600, compression=rng.choice(["zstd", "none"]))
    content = bytearray(path.read_bytes())
    for _ in range(rng.choice([1, 1, 3, 20])):
        content[rng.randrange(8, len(content))] = rng.randrange(256)
    path.write_bytes(content)
    complaint = ""
    try:
        with Recording(path) as recording:
            assert all(len(raw.data) < 10**4 for raw in recording.raw())
            list(recording.messages())
    except RecordingError as error:
        complaint = str(error)
    assert not complaint or str(path) in complaint


# ---------------------------------------------------------------------------------------------------- foreign files


def transforms_proto(stamp: int) -> bytes:
    proto = FrameTransforms()
    proto.transforms.add(
        timestamp=Timestamp(seconds=stamp // 10**9, nanos=stamp % 10**9),
        parent_frame_id="map",
        child_frame_id="base",
        rotation={"w": 1.0},
    )
    return bytes(proto.SerializeToString())


TRANSFORMS = ("foxglove.FrameTransforms", "protobuf", file_descriptor_set(FrameTransforms))


def write_foreign(path: Path, stamps: Sequence[int] = (30, 10, 20, 50, 40), **options: Any) -> Path:
    """A file as another program writes it: log times in receiving order, event times within the messages."""
    known = ("/tf", "protobuf", TRANSFORMS, [(1000 + i, transforms_proto(stamp)) for i, stamp in enumerate(stamps)])
    unknown = ("/secret", "cbor", None, [(1000 + i, b"?" * i) for i in range(len(stamps))])
    return foreign(path, known, unknown, profile="other", chunk_size=200, **options)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False, "use_summary_offsets": False},
        {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
    ],
    ids=["plain", "lz4", "none", "no chunks", "no index", "no message index", "no repeats", "nothing"],
)
def test_foreign_files_are_read_in_the_order_of_their_event_times(options: dict[str, Any], tmp_path: Path) -> None:
    with Recording(write_foreign(tmp_path / "foreign.mcap", **options)) as recording:
        assert not recording.torn
        assert recording.profile == "other"
        assert recording.streams["/tf"].message_type is Transforms
        assert [(m.stream, m.stamp, m.seq) for m in recording.messages()] == [
            ("/tf", stamp, rank) for rank, stamp in enumerate([10, 20, 30, 40, 50])
        ]
        assert [m.stamp for m in recording.messages(start=20, end=40)] == [20, 30, 40]
        secret = recording.streams["/secret"]
        assert (secret.message_type, secret.count, secret.bytes) == (None, 5, 10)
        assert [r.data for r in recording.raw(["/secret"], start=1002)] == [b"??", b"???", b"????"]
        with pytest.raises(RecordingError, match=r"'/secret' holds cbor messages.*raw\(\)"):
            list(recording.messages(["/secret"]))


def test_foreign_messages_of_equal_event_times_are_stamped_by_log_time(tmp_path: Path) -> None:
    path = write_foreign(tmp_path / "foreign.mcap", stamps=[30, 10, 10])
    assert read(path) == [("/tf", 1000), ("/tf", 1001), ("/tf", 1002)]


def test_a_foreign_raw_image_is_an_image_or_a_depth_image_by_its_encoding(tmp_path: Path) -> None:
    padded = np.arange(2 * 16, dtype=np.uint8).reshape(2, 16)
    schema = ("foxglove.RawImage", "protobuf", file_descriptor_set(RawImage))
    sizes = {"rgb": ("rgb8", 5, 2), "depth": ("32FC1", 3, 2), "bayer": ("bayer_rggb8", 8, 4), "odd": ("yv12", 15, 2)}
    topics = []
    for topic, (encoding, width, height) in sizes.items():
        image = RawImage(width=width, height=height, encoding=encoding, step=32 // height, data=padded.tobytes())
        topics.append((f"/{topic}", "protobuf", schema, [(7, image.SerializeToString())]))
    with Recording(foreign(tmp_path / "foreign.mcap", *topics)) as recording:
        found = {m.stream: m.message for m in recording.messages()}
        assert recording.streams["/odd"].message_type is None
    assert isinstance(found["/bayer"], Image)
    assert isinstance(found["/rgb"], Image)
    assert np.array_equal(found["/rgb"].data, padded[:, :15].reshape(2, 5, 3))
    assert isinstance(found["/depth"], DepthImage)
    assert np.array_equal(found["/depth"].data, np.ascontiguousarray(padded[:, :12]).view("<f4"), equal_nan=True)
    assert found["/rgb"].stamp == 7  # the log time, where the message carries none


def test_a_registered_decoder_makes_a_foreign_schema_readable(tmp_path: Path) -> None:
    def bind(schema: SchemaText) -> Callable[[bytes, int], Pose]:
        frame = schema.data.decode()
        return lambda data, log_time: build(Pose, log_time, dict(pose(0).items()) | {"frame": frame + data.decode()})

    register_decoder("text", "test.Pose", ForeignDecoder(bind))
    with pytest.raises(RecordingError, match="already"):
        register_decoder("text", "test.Pose", ForeignDecoder(bind))
    topic = ("/pose", "text", ("test.Pose", "text", b"map"), [(3, b"_2")])
    with Recording(foreign(tmp_path / "foreign.mcap", topic)) as recording:
        [read] = recording.messages()
    assert (read.stamp, read.message.frame) == (3, "map_2")


def test_a_type_that_is_not_declared_here_is_listed_and_raw(
    record: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = record([("a", pose(1)), ("b", Image(stamp=2, frame="c", data=[[1]]))])
    import dataflow.recording.streams.streams as streams

    known = {name: cls for name, cls in streams.message_types().items() if name != "Pose"}
    monkeypatch.setattr(streams, "message_types", lambda: known)
    with Recording(path) as recording:
        assert recording.streams["a"].message_type is None
        assert [m.stream for m in recording.messages()] == ["b"]
        assert [r.log_time for r in recording.raw(["a"])] == [1]
        with pytest.raises(RecordingError, match=r"of Pose.*import the module that declares it"):
            list(recording.messages(["a"]))


@pytest.mark.data
def test_other_programs_files_open(data_dir: Path) -> None:
    for path in sorted((data_dir / "bags").glob("*.mcap")):
        with Recording(path) as recording:
            assert recording.streams, path
            assert sum(1 for _ in recording.raw()) == sum(s.count for s in recording.streams.values()), path


@pytest.mark.data
def test_foxglove_json_becomes_our_messages(data_dir: Path) -> None:
    path = data_dir / "bags" / "foxglove_camera_jsonschema.mcap"
    with Recording(path) as recording:
        images = [m.message for m in recording.messages(["/image/compressed"])]
        [calibration, *_] = [m.message for m in recording.messages(["/camera_calibration"])]
        [first, *_] = [json.loads(r.data) for r in recording.raw(["/camera_calibration"])]
    assert len(images) == 10
    assert all(isinstance(m, CompressedImage) and m.format == "png" for m in images) or images[0].format == "jpeg"
    assert calibration.K.ravel().tolist() == first["K"]
    assert calibration.distortion.tolist() == first["D"]


def test_recording_of_a_newer_format_is_refused_with_a_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.recording.streams.writer.FORMAT", "2")
    path = recorded(tmp_path / "newer.mcap", [("robot1/a/pose", pose(1))], namespace="robot1")
    with pytest.raises(RecordingError, match=r"format '2'.*reads format '1'.*newer"):
        Recording(path)


def test_a_file_of_another_program_may_have_metadata_of_that_name(tmp_path: Path) -> None:
    with Recording(foreign(tmp_path / "foreign.mcap", metadata={"recording": {"format": "7"}})) as recording:
        assert recording.metadata["recording"] == {"format": "7"}
