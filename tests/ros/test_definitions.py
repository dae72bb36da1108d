"""Hashes of types by an independent computation, and messages there and back."""

from __future__ import annotations

import hashlib
import json
import os
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from example_messages import example

from dataflow.interop.conversions import convert
from dataflow.interop.ros import CONVERSIONS
from dataflow.interop.ros.to_ros2 import OUTWARD
from dataflow.messages import (
    CameraInfo,
    CompressedDepth,
    Detections2D,
    Diagnostics,
    Measurement,
    Message,
    MessageError,
    Number,
    Odometry,
    Path,
    Pose,
    RangeReading,
    Twist,
)
from dataflow.recording.errors import RecordingError
from dataflow.ros.definitions import Distro, clock_time, distros_of, reader_for, store_of, type_hash, written
from dataflow.ros.message import RosMessage

HASHED: tuple[Distro, ...] = ("jazzy", "kilted", "lyrical")
MAPPED = sorted(name for name in CONVERSIONS if name not in ("tf/msg/tfMessage", "rosgraph_msgs/msg/Log"))
"""All that are mapped, but for two types of ROS 1."""

PUBLISHED = {
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "geometry_msgs/msg/Point": "6963084842a9b04494d6b2941d11444708d892da2f4b09843b9c43f42a7f6881",
    "geometry_msgs/msg/Pose": "d501954e9476cea2996984e812054b68026ae0bfae789d9a10b23daf35cc90fa",
    "geometry_msgs/msg/PoseWithCovariance": "9a7c0fd234b7f45c6098745ecccd773ca1085670e64107135397aee31c02e1bb",
    "geometry_msgs/msg/TransformStamped": "0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206",
    "geometry_msgs/msg/Twist": "9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "rosgraph_msgs/msg/Clock": "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    "sensor_msgs/msg/CameraInfo": "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    "sensor_msgs/msg/CompressedImage": "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/Imu": "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/msg/NavSatFix": "62223ab3fe210a15976021da7afddc9e200dc9ec75231c1b6a557fc598a65404",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "std_msgs/msg/Float32": "7170d3d8f841f7be3172ce5f4f59f3a4d7f63b0447e8b33327601ad64d83d6e2",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""Taken from installations of Jazzy by others, who published them: CARLA's tests of its ROS 2 types (July 2026, from
the packages' JSON), rcl's test_type_hash.cpp, `ros2 topic info -v`, metadata of bags."""

IDS = {
    "int8": 2, "uint8": 3, "byte": 16, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8, "uint64": 9,
    "float32": 10, "float64": 11, "char": 13, "bool": 15, "string": 17, "wstring": 18,
}  # fmt: skip
"""type_description_interfaces/FieldType of scalars; an array is 48 more, a bounded sequence 96, an unbounded 144."""
FIELD = re.compile(r"^([\w/]+)(?:<=(\d+))?(?:\[(<=)?(\d*)\])? (\w+)$")


def described(name: str, definitions: dict[str, str]) -> dict[str, Any]:
    """A type's description by REP 2011, read from the text of its definition."""
    fields = []
    for line in definitions[name].splitlines():
        if (found := FIELD.match(line.strip())) is None:
            assert "=" in line or not line.strip(), line
            continue
        base, longest, bounded, extent, field = found.groups()
        array = "[" in line
        offset = 0 if not array else 144 if not extent else 96 if bounded else 48
        known = 21 if base == "string" and longest else IDS.get(base)
        nested = "" if known else re.sub(r"^(\w+)/(?:msg/)?", r"\1/msg/", base)
        kind = {
            "type_id": offset + (known or 1),
            "capacity": int(extent or 0),
            "string_capacity": int(longest or 0),
            "nested_type_name": nested,
        }
        fields.append({"name": field, "type": kind})
    return {"type_name": name, "fields": fields}


def rihs01(name: str, text: str) -> str:
    first, *others = text.split("=" * 80 + "\n")
    definitions = {name: first}
    for other in others:
        head, _, body = other.partition("\n")
        package, _, kind = head.removeprefix("MSG: ").partition("/")
        definitions[f"{package}/msg/{kind.removeprefix('msg/')}"] = body
    rest = [described(other, definitions) for other in sorted(definitions) if other != name]
    whole = {"type_description": described(name, definitions), "referenced_type_descriptions": rest}
    return "RIHS01_" + hashlib.sha256(json.dumps(whole).encode()).hexdigest()


@pytest.mark.parametrize("distro", HASHED)
def test_hashes_of_all_mapped_types_equal_an_independent_computation(distro: Distro) -> None:
    store = store_of(distro)
    for name in MAPPED:
        assert type_hash(name, distro) == rihs01(name, store.generate_msgdef(name, ros_version=2)[0]), name


@pytest.mark.parametrize("distro", HASHED)
def test_hashes_equal_those_that_ros_has_published(distro: Distro) -> None:
    assert {name: type_hash(name, distro) for name in PUBLISHED} == {n: f"RIHS01_{h}" for n, h in PUBLISHED.items()}


def test_humble_has_no_hashes_and_a_changed_type_names_its_distributions() -> None:
    kind = "sensor_msgs/msg/Range"
    assert type_hash(kind, "humble") == "TypeHashNotSupported"
    assert distros_of(kind, "TypeHashNotSupported") == ("humble",)
    assert distros_of(kind, type_hash(kind, "jazzy") or "") == ("lyrical", "kilted", "jazzy")
    assert distros_of(kind, store_of("humble").hash_rihs01(kind)) == ()
    assert type_hash("my_robot/msg/Gripper", "jazzy") is None


def messages() -> Iterator[Message]:
    """Several of each type that ROS has; among random ones are some that it has no numbers for."""
    for kind in OUTWARD:
        for seed in range(8):
            message = example(kind, seed).replace(stamp=10**18 + 7)
            if isinstance(message, CompressedDepth):
                message = message.replace(quantizer="linear", scale=0.001, offset=0.0)  # millimetres, as ROS has them
            yield message
    yield Measurement(stamp=10**18 + 7, frame="imu", value=21.5, unit="°C", variance=0.25)
    yield Path(stamp=10**18 + 7, frame="map", positions=[[1.0, 2.0, 3.0]])
    yield CameraInfo.from_intrinsics(stamp=10**18 + 7, frame="camera", width=64, height=48, fx=50, fy=50, cx=32, cy=24)


@pytest.mark.filterwarnings("ignore:invalid value")  # random numbers, infinite ones among them
@pytest.mark.parametrize("distro", ["humble", *HASHED])
def test_every_type_goes_out_and_comes_in_again(distro: Distro) -> None:
    done = set()
    for message in messages():
        try:
            kind, hash_, data = written(message, "", distro)
            reader = reader_for("/t", kind, distro)
            back = convert(reader.read(data, 0, message.stamp), type(message))
        except (RecordingError, MessageError):
            continue
        assert hash_ == type_hash(kind, distro)
        assert type(back) is type(message)
        assert set(reader.stamps(data)) <= {message.stamp}, kind
        done.add(type(message))
    assert done == set(OUTWARD)


def test_a_part_of_a_message_can_be_sent_as_its_type() -> None:
    twist = Twist(stamp=5 * 10**9, frame="base", linear=(1, 2, 3), angular=(4, 5, 6))
    kind, hash_, data = written(twist, "geometry_msgs/msg/Twist", "jazzy")
    assert (kind, hash_) == ("geometry_msgs/msg/Twist", f"RIHS01_{PUBLISHED[kind]}")
    assert np.frombuffer(data, "<f8", 6, 4).tolist() == [1, 2, 3, 4, 5, 6]
    stamped = written(twist, "geometry_msgs/msg/TwistStamped", "jazzy")[2]
    back = reader_for("/cmd", "geometry_msgs/msg/TwistStamped", "jazzy").read(stamped, 0, twist.stamp)
    assert back.digest() == twist.digest()
    pose = Pose(stamp=7, frame="map", child_frame="", position=(1, 2, 3), orientation=(0, 0, 0, 1))
    again = written(pose, "geometry_msgs/msg/PoseStamped", "jazzy")[2]
    assert reader_for("/goal", "geometry_msgs/msg/PoseStamped", "jazzy").read(again, 0, 7).digest() == pose.digest()
    assert written(Number(stamp=1, value=3.0, unit=""), "std_msgs/msg/UInt8", "jazzy")[2] == b"\0\1\0\0\3"


def test_unsendable_message_is_refused_with_the_reason() -> None:
    odometry = example(Odometry, 1).replace(stamp=5)
    for message, kind, said in (
        (odometry, "sensor_msgs/msg/Imu", "is sent as nav_msgs/msg/Odometry or its parts"),
        (odometry, "my_robot/msg/Gripper", "is not a type of ROS 2 jazzy"),
        (Number(stamp=1, value=0.5, unit=""), "std_msgs/msg/Int32", "no whole number"),
        (Number(stamp=1, value=300.0, unit=""), "std_msgs/msg/UInt8", "does not fit"),
        (RosMessage(stamp=1, type="a/msg/B", hash="h", data=np.zeros(4, np.uint8)), "a/msg/C", "a/msg/B came"),
    ):
        with pytest.raises(RecordingError, match=said):
            written(message, kind, "jazzy")


def test_a_range_keeps_its_variance_where_the_distribution_has_a_place_for_it() -> None:
    reading = example(RangeReading, 1).replace(stamp=5, variance=0.25)
    humble, jazzy = (written(reading, "", distro)[2] for distro in ("humble", "jazzy"))
    assert len(jazzy) == len(humble) + 4
    assert np.frombuffer(jazzy[-4:], "<f4")[0] == np.float32(0.25)


def test_a_raw_message_stays_as_it_is() -> None:
    raw = RosMessage(stamp=1, type="my_robot/msg/Gripper", hash="RIHS01_7", data=np.arange(9, dtype=np.uint8))
    assert written(raw, "", "humble") == ("my_robot/msg/Gripper", "RIHS01_7", bytes(range(9)))


def test_the_time_of_a_clock_is_read_in_both_byte_orders() -> None:
    assert clock_time(bytes.fromhex("0001000005000000" + "07000000")) == 5 * 10**9 + 7
    assert clock_time(bytes.fromhex("0000000000000005" + "00000007")) == 5 * 10**9 + 7
    with pytest.raises(RecordingError, match="too short"):
        clock_time(b"\0\1\0\0")


def test_numbers_that_overflow_are_refused_as_unreadable() -> None:
    status = Diagnostics(
        stamp=1, names=("abc",), messages=("",), keys=(), values=(), levels=np.array([1], np.uint8), owners=None
    )
    boxes = np.array([[0, 0, 61.5, 10]], np.float32)
    found = Detections2D(
        stamp=1, frame="c", width=64, height=64, class_names=("a",), boxes=boxes, scores=[1.0], class_ids=[0]
    )
    for message, there, hostile in (
        (status, b"\1\0\0\0\4\0\0\0abc\0", b"\xff\0\0\0\4\0\0\0abc\0"),
        (found, struct.pack("<d", 61.5), struct.pack("<d", np.inf)),
    ):
        kind, _, data = written(message, "", "jazzy")
        assert data.count(there) == 1
        with pytest.raises(RecordingError, match=f"a {kind} whose fields contradict each other"):
            reader_for("/hostile", kind, "jazzy").read(data.replace(there, hostile), 0, 1)


def test_types_without_a_counterpart_are_refused_by_typed_sources() -> None:
    with pytest.raises(RecordingError, match="Ros2Source passes it on"):
        reader_for("/b", "sensor_msgs/msg/BatteryState", "jazzy")


PYTERFACES = """
import importlib, json, pkgutil
import ros2_pyterfaces.core as core

found = {}
for package in pkgutil.iter_modules(core.__path__):
    if package.ispkg and importlib.util.find_spec(f"ros2_pyterfaces.core.{package.name}.msg"):
        module = importlib.import_module(f"ros2_pyterfaces.core.{package.name}.msg")
        named = [each for each in vars(module).values() if isinstance(each, dict) and "__typename" in each]
        found |= {core.get_type_name(each): core.hash_rihs01(each) for each in named}
print(json.dumps(found))
"""


@pytest.mark.parametrize("distro", HASHED)
def test_hashes_are_those_of_definitions_that_others_wrote_down(distro: Distro) -> None:
    pytest.importorskip("ros2_pyterfaces", reason="ros2-pyterfaces is not installed: pip install ros2-pyterfaces")
    command = [sys.executable, "-c", PYTERFACES]
    variables = {**os.environ, "DISTRO": distro}
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, env=variables).stdout
    theirs = json.loads(told)
    both = [type_ for type_ in CONVERSIONS if type_ in theirs and type_hash(type_, distro) is not None]
    assert len(both) >= 44  # it lacks tf2_msgs, vision_msgs, and those of Foxglove and FFmpeg
    assert {type_: type_hash(type_, distro) for type_ in both} == {type_: theirs[type_] for type_ in both}
