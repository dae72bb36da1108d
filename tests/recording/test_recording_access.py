"""Random access to one stream gives what reading it whole gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataflow.messages import CameraInfo, Imu, Odometry
from dataflow.recording import Recording, RecordingError, RecordingWriter


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


def test_fields_are_those_of_the_message_and_what_is_none_is_left_out(recording: Recording) -> None:
    for stream in ("r/imu", "r/odometry", "r/info"):
        index = recording.index(stream)
        for place in range(len(index)):
            values = {n: v for n, v in index.read(place).message.items() if n != "stamp" and v is not None}
            found = index.fields(place, [f.name for f in type(index.read(place).message).FIELDS])
            assert found.keys() == values.keys()
            for name, value in values.items():
                np.testing.assert_array_equal(found[name], value)
    assert recording.index("r/imu").fields(1, ["temperature"]) == {"temperature": 20.0}


def test_unknown_streams_are_named(recording: Recording) -> None:
    with pytest.raises(RecordingError, match="no stream 'r/gyro'"):
        recording.index("r/gyro")
