"""Every message type survives a recording bit for bit, and other tools read the same values from it."""

from __future__ import annotations

import base64
import json
import math
import struct
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from example_messages import example
from hypothesis import given, settings
from hypothesis import strategies as st
from made_recordings import recorded
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dataflow.messages import (
    CameraInfo,
    CompressedImage,
    CompressedVideo,
    DepthImage,
    Image,
    LaserScan,
    Message,
    NavSatFix,
    Odometry,
    PointCloud,
    Pose,
    Transforms,
    array,
    message_types,
    scalar,
)
from dataflow.messages import Path as PathMessage
from dataflow.recording import Recording
from dataflow.recording.layout import DIGESTS
from dataflow.recording.streams.codecs import codec_for
from dataflow.recording.streams.json_codec import LONG_BYTES, MAX_SAFE_INTEGER

TYPES = {name: cls for name, cls in message_types().items() if cls.__module__.startswith("dataflow.messages.")}


class Awkward(Message, schema="test.Awkward"):
    """Every kind of field that JSON has trouble with."""

    number: float = scalar("float", "any float", default=0.0)
    count: int = scalar("int", "any 64-bit integer", default=0)
    maybe: int | None = scalar("int", "an integer or None", default=None)
    flag: bool = scalar("bool", "a flag", default=False)
    words: tuple[str, ...] = scalar("strs", "any strings", default=())
    small: Any = array("float32|float64", "N|N 2|N 0", "two dtypes, three shapes", optional=True)
    whole: Any = array("int64|uint64", "K", "integers beyond 2^53", optional=True)


class Long(Message, schema="test.Long"):
    """Long arrays beside texts that look like their places."""

    base64: str = scalar("str", "any text")
    before: Any = array("uint8", "N", "bytes", optional=True)
    words: tuple[str, ...] = scalar("strs", "any strings", default=())
    after: Any = array("float64", "N", "numbers", optional=True)
    number: int = scalar("int", "any 64-bit integer", default=0)


def valid(cls: type[Message], seed: int) -> Message:
    """An example whose stamp a recording can hold."""
    message = example(cls, seed)
    return message.replace(stamp=abs(message.stamp))


def through_codec(message: Message) -> Message:
    codec = codec_for(type(message))
    parts, companion = codec.encode(message)
    return codec.decode(message.stamp, memoryview(b"".join(parts)), companion)


@pytest.fixture(scope="module")
def every_type(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[Message]]]:
    """One recording that holds several examples of every registered type, and those examples."""
    written = {
        f"robot/{name}/out": [valid(cls, seed).replace(stamp=10**18 + seed) for seed in range(6)]
        for name, cls in TYPES.items()
    }
    rows = [(stream, message) for stream, messages in written.items() for message in messages]
    return recorded(tmp_path_factory.mktemp("every") / "every_type.mcap", rows), written


@pytest.mark.parametrize("name", sorted(TYPES))
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**20))
def test_every_type_keeps_its_digest(name: str, seed: int) -> None:
    message = valid(TYPES[name], seed)
    assert through_codec(message).digest() == message.digest()


def test_every_type_keeps_its_digest_through_a_file(every_type: tuple[Path, dict[str, list[Message]]]) -> None:
    path, written = every_type
    with Recording(path) as recording:
        read: dict[str, list[Message]] = {}
        for found in recording.messages():
            read.setdefault(found.stream, []).append(found.message)
        assert {s: [m.digest() for m in ms] for s, ms in read.items()} == {
            s: [m.digest() for m in ms] for s, ms in written.items()
        }
        assert recording.digests() == recording.metadata[DIGESTS]


bits = st.integers(0, 2**64 - 1).map(lambda b: struct.unpack("<d", struct.pack("<Q", b))[0])


@settings(max_examples=80, deadline=None)
@given(
    number=st.one_of(st.floats(), bits),
    count=st.integers(-(2**63), 2**63 - 1),
    maybe=st.none() | st.integers(-(2**53) - 2, 2**53 + 2),
    words=st.lists(st.text(max_size=5), max_size=3),
    small=st.none() | st.lists(st.floats(width=32) | st.just(-0.0), max_size=70),
    wide=st.booleans(),
    pairs=st.booleans(),
    whole=st.none() | st.lists(st.integers(-(2**63), 2**63 - 1), max_size=4),
)
def test_json_keeps_every_bit_of_awkward_values(
    number: float, count: int, maybe: int | None, words: list[str], small: Any, wide: bool, pairs: bool, whole: Any
) -> None:
    if small is not None:
        small = np.array(small, np.float64 if wide else np.float32)
        small = small[: len(small) // 2 * 2].reshape(-1, 2) if pairs else small
    message = Awkward(stamp=5, number=number, count=count, maybe=maybe, words=words, small=small, whole=whole)
    assert through_codec(message).digest() == message.digest()
    [data], _ = codec_for(Awkward).encode(message)
    jsonschema.validate(json.loads(bytes(data)), json.loads(codec_for(Awkward).schema.data))


@pytest.mark.parametrize(
    "shape",
    [(0, 2), (3, 0), (0,), (64,), (65,)],
    ids=["empty pairs", "pairs of nothing", "empty", "longest list", "shortest packed"],
)
def test_json_keeps_the_shape_of(shape: tuple[int, ...]) -> None:
    message = Awkward(stamp=0, small=np.zeros(shape, np.float64))
    back = through_codec(message)
    assert back.small.shape == shape
    assert back.digest() == message.digest()


@pytest.mark.parametrize("elements", [LONG_BYTES // 8 - 1, LONG_BYTES // 8, LONG_BYTES], ids="{} elements".format)
@pytest.mark.parametrize("text", ["\0", '"base64":"\0"', '\\u0000","base64":"', "plain"])
def test_json_of_long_arrays_equals_that_of_the_encoder(elements: int, text: str) -> None:
    numbers, octets = np.linspace(0, 1, elements), np.arange(elements, dtype=np.uint8)
    message = Long(stamp=3, base64=text, before=octets, words=[text] * 2, after=numbers, number=2**60)
    [data], _ = codec_for(Long).encode(message)
    told = json.loads(bytes(data))
    assert json.dumps(told, ensure_ascii=False, separators=(",", ":")).encode() == bytes(data)
    assert base64.b64decode(told["_exact"]["after"]["base64"]) == numbers.tobytes()
    assert through_codec(message).digest() == message.digest()


def test_json_integers_beyond_two_to_the_53_are_strings() -> None:
    [data], _ = codec_for(Awkward).encode(Awkward(stamp=0, count=MAX_SAFE_INTEGER + 1, maybe=MAX_SAFE_INTEGER))
    value = json.loads(bytes(data))
    assert value["maybe"] == MAX_SAFE_INTEGER
    assert value["_exact"]["count"] == str(MAX_SAFE_INTEGER + 1)


def test_json_schemas_use_one_type_per_property() -> None:
    """Plotting tools know no unions: every property, at any depth, has one `type`; arrays hold simple items."""

    def check(schema: dict[str, Any], where: str) -> None:
        assert isinstance(schema["type"], str), where
        assert not {"oneOf", "anyOf", "allOf"} & schema.keys(), where
        if schema["type"] == "array":
            assert schema["items"]["type"] in ("boolean", "integer", "number", "string"), where
        if schema["type"] == "object":
            for name, inner in schema["properties"].items():
                check(inner, f"{where}.{name}")

    for name, cls in TYPES.items():
        codec = codec_for(cls)
        for schema in (codec.schema, codec.companion_schema):
            if schema is not None and schema.encoding == "jsonschema":
                check(json.loads(schema.data), name)


def test_json_messages_satisfy_the_schema_in_the_file(every_type: tuple[Path, dict[str, list[Message]]]) -> None:
    checked = 0
    with every_type[0].open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.message_encoding == "json":
                assert schema is not None
                assert schema.encoding == "jsonschema"
                validator = jsonschema.Draft202012Validator(json.loads(schema.data))
                validator.validate(json.loads(message.data))
                checked += 1
    assert checked > 6 * 15


def decoded_elsewhere(path: Path) -> dict[str, list[Any]]:
    """Every protobuf message by topic, as `mcap` and `mcap_protobuf` read it with the schemas in the file."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        topics = {
            c.topic for c in make_reader(file).get_summary().channels.values() if c.message_encoding == "protobuf"
        }
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, proto in reader.iter_decoded_messages(topics=topics):
            assert message.log_time == message.publish_time
            found.setdefault(channel.topic, []).append(proto)
    return found


def same_depth(m: DepthImage, p: Any) -> bool:
    """Metres as floats, or millimetres, as REP 118 has them."""
    if p.encoding == "32FC1":
        return bool(p.data == m.data.tobytes())
    return bool(np.array_equal(np.frombuffer(p.data, "<u2").astype(np.float32) / np.float32(1000), m.data.ravel()))


def test_well_known_types_read_the_same_with_mcap_alone(every_type: tuple[Path, dict[str, list[Message]]]) -> None:
    path, written = every_type
    found = decoded_elsewhere(path)
    checks = {
        Image: lambda m, p: (
            (p.encoding == ("rgb8" if m.is_color else "mono8"))
            and (p.height, p.width, p.step) == (m.height, m.width, m.width * (3 if m.is_color else 1))
            and p.data == m.data.tobytes()
        ),
        DepthImage: lambda m, p: (
            (p.height, p.width, p.step) == (*m.data.shape, {"32FC1": 4, "16UC1": 2}[p.encoding] * m.width)
            and same_depth(m, p)
        ),
        CompressedImage: lambda m, p: (p.format, p.data) == (m.format, m.data.tobytes()),
        CompressedVideo: lambda m, p: (p.format, p.data) == (m.format, m.data.tobytes()),
        CameraInfo: lambda m, p: list(p.K) == m.K.ravel().tolist() and len(p.R) == 9 and len(p.P) == 12,
        PointCloud: same_cloud,
        Pose: same_pose,
        Odometry: same_pose,
        Transforms: lambda m, p: (
            [(t.parent_frame_id, t.child_frame_id) for t in p.transforms]
            == list(zip(m.frames, m.child_frames, strict=True))
            and np.array_equal(
                np.array([[t.translation.x, t.translation.y, t.translation.z] for t in p.transforms]).reshape(-1, 3),
                m.translations,
                equal_nan=True,
            )
            and [[t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w] for t in p.transforms] == m.rotations.tolist()
        ),
        PathMessage: lambda m, p: np.array_equal(
            np.array([[q.position.x, q.position.y, q.position.z] for q in p.poses]).reshape(-1, 3),
            m.positions,
            equal_nan=True,
        ),
        LaserScan: lambda m, p: (
            np.array_equal(np.array(p.ranges, np.float32), m.ranges, equal_nan=True)
            and (p.start_angle, p.end_angle) == (m.angle_min, m.angle_max)
        ),
        NavSatFix: lambda m, p: np.array_equal(
            [p.latitude, p.longitude, p.altitude], [m.latitude, m.longitude, m.altitude], equal_nan=True
        ),
    }
    for cls, same in checks.items():
        stream = f"robot/{cls.SCHEMA}/out"
        assert len(found[stream]) == len(written[stream])
        for message, proto in zip(written[stream], found[stream], strict=True):
            assert same(message, proto), (message, proto)
            if cls is not Transforms:
                assert proto.timestamp.seconds * 10**9 + proto.timestamp.nanos == message.stamp
                assert proto.frame_id == message.frame


def same_pose(message: Any, proto: Any) -> bool:
    p, q = proto.pose.position, proto.pose.orientation
    return np.array_equal([p.x, p.y, p.z], message.position, equal_nan=True) and (
        [q.x, q.y, q.z, q.w] == message.orientation.tolist()
    )


def same_cloud(message: Any, proto: Any) -> bool:
    """Reads each packed column by name, one point at a time."""
    kinds = {1: "B", 3: "<H", 7: "<f"}
    columns = {
        f.name: [
            struct.unpack_from(kinds[f.type], proto.data, i * proto.point_stride + f.offset)[0]
            for i in range(len(message.points))
        ]
        for f in proto.fields
    }
    expected: dict[str, Any] = dict(zip("xyz", message.points.T, strict=True))
    if message.colors is not None:
        expected |= dict(zip(("red", "green", "blue"), message.colors.T, strict=True))
        expected["alpha"] = np.full(len(message.points), 255)
    if message.normals is not None:
        expected |= dict(zip(("normal_x", "normal_y", "normal_z"), message.normals.T, strict=True))
    for name, column in (("intensities", "intensity"), ("rings", "ring"), ("time_offsets", "time_offset")):
        if getattr(message, name) is not None:
            expected[column] = getattr(message, name)
    return columns.keys() == expected.keys() and all(
        np.array_equal(columns[c], expected[c], equal_nan=True) for c in expected
    )


def test_signalling_nan_in_a_scan_keeps_its_bits() -> None:
    ranges = np.array([0x7F800001, 0x3F800000], np.uint32).view(np.float32)
    scan = LaserScan(stamp=1, frame="lidar", angle_min=0.0, angle_max=1.0, ranges=ranges)
    assert through_codec(scan).ranges.view(np.uint32).tolist() == [0x7F800001, 0x3F800000]


def test_negative_zero_survives_in_protobuf() -> None:
    pose = Pose(stamp=1, frame="map", position=[-0.0, 0.0, -0.0], orientation=[0.0, -0.0, 0.0, 1.0])
    back = through_codec(pose)
    assert [math.copysign(1, v) for v in back.position] == [-1.0, 1.0, -1.0]
    assert back.digest() == pose.digest()


def test_read_arrays_are_aligned_and_frozen(every_type: tuple[Path, dict[str, list[Message]]]) -> None:
    with Recording(every_type[0]) as recording:
        for found in recording.messages():
            for data in found.message.arrays():
                assert data is None or (data.flags.aligned and not data.flags.writeable and data.flags.c_contiguous)
