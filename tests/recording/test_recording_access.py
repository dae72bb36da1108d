"""Random access to one stream gives what reading it whole gives."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from example_messages import example
from made_recordings import foreign, recorded

from dataflow.messages import CameraInfo, Imu, Message, Odometry
from dataflow.messages.base import is_built_in, message_types
from dataflow.recording import Recording, RecordingError, RecordingWriter
from dataflow.recording.streams import access


def imu(stamp: int, **fields: object) -> Imu:
    return Imu(stamp=stamp, frame="imu", angular_velocity=[stamp, 0, 0], linear_acceleration=[0, 0, 9.81], **fields)


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    path = tmp_path / "made.mcap"
    with RecordingWriter(path, metadata={}, namespace="r") as writer:
        writer.add_stream("r/imu", Imu)
        writer.add_stream("r/odometry", Odometry)
        writer.add_stream("r/info", CameraInfo, static=True)
        writer.write("r/info", CameraInfo(stamp=0, frame="c", width=4, height=3, K=np.eye(3)), seq=0)
        for i in range(5):
            writer.write("r/imu", imu(100 + 10 * i, temperature=20.0 if i % 2 else None), seq=i)
            pose = {"position": [i, 0, 0], "orientation": [0, 0, 0, 1], "linear": [i, 0, 0] if i else None}
            writer.write("r/odometry", Odometry(stamp=101 + i, frame="odom", child_frame="base", **pose), seq=i)
        writer.write("r/imu", imu(50), seq=0, incarnation=1)  # the clock has jumped back
    return Recording(path)


@pytest.mark.parametrize("stream", ["r/imu", "r/odometry", "r/info"])
def test_messages_by_place_are_those_of_reading_in_order(recording: Recording, stream: str) -> None:
    index, whole = recording.index(stream), list(recording.messages([stream]))

    assert [index.read(i) for i in range(len(index))] == whole
    assert index.stamps.tolist() == [item.stamp for item in whole]


def test_an_interval_is_cut_as_in_reading(recording: Recording) -> None:
    index = recording.index("r/imu", 110, 130)

    assert index.stamps.tolist() == [110, 120, 130]
    assert index.read(-1).stamp == 130


@pytest.mark.parametrize("stream", ["r/imu", "r/odometry", "r/info"])
def test_columns_are_the_fields_of_the_messages(recording: Recording, stream: str) -> None:
    index = recording.index(stream)
    messages = [index.read(place).message for place in range(len(index))]
    names = [field.name for field in type(messages[0]).FIELDS]
    found = index.columns(np.arange(len(index)), names)

    for name in names:
        for value, message in zip(found[name], messages, strict=True):
            np.testing.assert_array_equal(value, getattr(message, name))


@pytest.mark.parametrize("cls", [c for c in message_types().values() if is_built_in(c)], ids=lambda c: c.SCHEMA)
def test_columns_of_any_type_are_exact(cls: type[Message], tmp_path: Path) -> None:
    """Also where fields hold what plain JSON cannot: NaN with a payload, -0.0, large integers, empty sets."""
    messages = [example(cls, seed).replace(stamp=seed + 1) for seed in (0, 1, 2, 3, 0, 4)]
    messages = [message.replace(stamp=stamp) for stamp, message in enumerate(messages, 1)]
    with Recording(recorded(tmp_path / "any.mcap", [("any", message) for message in messages])) as recording:
        columns = recording.index("any").columns(np.arange(6), [field.name for field in cls.FIELDS])

    rebuilt = [{name: values[i] for name, values in columns.items()} for i in range(6)]
    assert [cls(stamp=m.stamp, **fields) for m, fields in zip(messages, rebuilt, strict=True)] == messages


def test_columns_of_many_messages_are_joined_from_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "BATCH", 3)
    rows = [("imu", imu(i + 1, temperature=1.5 if i == 7 else None)) for i in range(8)]
    with Recording(recorded(tmp_path / "many.mcap", rows)) as recording:
        found = recording.index("imu").columns(np.arange(8), ["angular_velocity", "temperature"])

    assert np.asarray(found["angular_velocity"])[:, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert found["temperature"] == [None] * 7 + [1.5]


def test_columns_of_another_programs_stream_are_those_of_its_messages(tmp_path: Path) -> None:
    messages = []
    for k in range(3):
        image = {"width": 2, "height": 1, "encoding": "mono8", "step": 2, "frame_id": f"camera{k}"}
        data = base64.b64encode(bytes([k, k + 1])).decode()
        messages.append((k, json.dumps({**image, "data": data}).encode()))
    path = foreign(tmp_path / "foreign.mcap", ("/grey", "json", ("foxglove.RawImage", "jsonschema", b"{}"), messages))

    with Recording(path) as recording:
        found = recording.index("/grey").columns(np.arange(3), ["frame", "data"])

    assert list(found["frame"]) == ["camera0", "camera1", "camera2"]
    assert np.array(found["data"]).tolist() == [[[0, 1]], [[1, 2]], [[2, 3]]]


@pytest.mark.parametrize("damage", [b'{"value":[1],"unit":""}', b'{"value":', b"[1]", b'{"_exact":3}'])
def test_a_message_that_does_not_decode_is_named(tmp_path: Path, damage: bytes) -> None:
    facts = {"kind": "stream", "message_type": "Number", "static": "false", "incarnation": "0"}
    messages = [(1, b'{"value":1.0,"unit":""}'), (2, damage)]
    number = ("number", "json", ("dataflow.Number", "jsonschema", b"{}"), messages)
    path = foreign(tmp_path / "damaged.mcap", number, of_channels=facts)

    with Recording(path) as recording:
        with pytest.raises(RecordingError, match="stream 'number', message 1 at 2") as one:
            recording.index("number").read(1)
        with pytest.raises(RecordingError) as many:
            recording.index("number").columns(np.arange(2), ["value"])
    assert str(many.value) == str(one.value)


def test_unknown_streams_are_named(recording: Recording) -> None:
    with pytest.raises(RecordingError, match="no stream 'r/gyro'"):
        recording.index("r/gyro")
