"""The place of sensors whose measurements are handed in: its streams, and that it has none itself."""

from __future__ import annotations

import pytest

from dataflow.graph import load_text
from dataflow.testing import play
from operators.perception.sensors import HandedSensors

GRAPH = "graph: handed\noperators: {sensors: {use: 'operators.perception.sensors:HandedSensors'}}\n"


def test_handed_sensors_have_static_calibrations() -> None:
    graph = load_text(GRAPH)
    node = graph.nodes["sensors"]
    assert node.source
    assert HandedSensors.real_time
    streams = {port: graph.streams[name] for port, name in node.outputs.items()}
    assert {port for port, stream in streams.items() if stream.static} == {"image_info", "depth_info", "extrinsics"}
    assert {port: stream.types[0] for port, stream in streams.items() if not stream.static} == {
        "image": "Image", "depth": "DepthImage", "points": "PointCloud", "imu": "Imu", "wheels": "Odometry",
        "command": "Twist",
    }  # fmt: skip


def test_it_refuses_to_be_run_as_a_device() -> None:
    with pytest.raises(RuntimeError, match="gives only what a PerceptionSystem is handed"):
        play(HandedSensors())
