"""The place of sensors whose measurements are handed in: its streams, and that it has none itself."""

from __future__ import annotations

import pytest

from dataflow.graph import load_text
from dataflow.testing import play
from operators.perception.sensors import HandedSensors

GRAPH = "graph: handed\noperators: {sensors: {use: 'operators.perception.sensors:HandedSensors'}}\n"


def test_it_stands_for_a_device_whose_calibrations_are_static() -> None:
    node = load_text(GRAPH).nodes["sensors"]
    streams = load_text(GRAPH).streams

    assert node.source
    assert HandedSensors.real_time
    static = {port for port, name in node.outputs.items() if streams[name].static}
    assert static == {"image_info", "depth_info", "extrinsics"}
    assert {port: streams[name].types for port, name in node.outputs.items() if port not in static} == {
        "image": ("Image",),
        "depth": ("DepthImage",),
        "points": ("PointCloud",),
        "imu": ("Imu",),
        "wheels": ("Odometry",),
        "command": ("Twist",),
    }


def test_it_refuses_to_be_run_as_a_device() -> None:
    with pytest.raises(RuntimeError, match="gives only what a PerceptionSystem is handed"):
        play(HandedSensors())
