"""Parameters of ROS sources that cannot be are refused before anything connects."""

from __future__ import annotations

import pytest

import dataflow.ros as topics
from dataflow.graph import GraphError, load_text
from dataflow.interop.ros import CONVERSIONS

GRAPH = "graph: ros\nnamespace: test\noperators:\n  imu: {use: 'dataflow.ros:Imu', params: {topic: '%s', type: '%s'}}\n"


@pytest.mark.parametrize("topic", ["/*", "/cam two", "imu/", "", "/imu//data", "/2d", "/a$b"])
def test_a_name_that_no_topic_has_is_a_fault_of_the_graph(topic: str) -> None:
    with pytest.raises(GraphError, match="topic"):
        load_text(GRAPH % (topic, ""))


@pytest.mark.parametrize("type_", ["sensor_msgs/Imu", "Imu", "sensor_msgs/srv/SetCameraInfo"])
def test_a_type_is_named_as_ros_2_does(type_: str) -> None:
    with pytest.raises(GraphError, match="type"):
        load_text(GRAPH % ("/imu", type_))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("namespace", "my ns/*"),
        ("namespace", "/robot/"),
        ("node", "no de"),
        ("node", "a/b"),
        ("router", "127.0.0.1:7447"),
        ("router", ""),
    ],
)
@pytest.mark.parametrize("use", ["Imu", "Ros2Sink"])
def test_names_and_endpoints_that_cannot_be_are_faults_of_the_graph(name: str, value: str, use: str) -> None:
    source = "from: {use: 'dataflow.ros:Imu', params: {topic: /a}}"
    inputs = ", inputs: {message: from/message}" if use == "Ros2Sink" else ""
    operators = f"  {source}\n  at: {{use: 'dataflow.ros:{use}'{inputs}, params: {{topic: /b, {name}: '%s'}}}}\n"
    text = f"graph: ros\nnamespace: test\noperators:\n{operators}"
    with pytest.raises(GraphError, match=name):
        load_text(text % value)
    load_text(text % {"namespace": "/robot_1/arm", "node": "eyes", "router": "tls/[::1]:7447"}[name])


def test_valid_ros_topic_names_are_accepted() -> None:
    for topic in ("imu", "/imu", "/robot/imu_1/data", "~/imu"):
        load_text(GRAPH % (topic, "sensor_msgs/msg/Imu"))


@pytest.mark.parametrize("use", ["Imu", "StaticTransforms"])
def test_a_type_that_becomes_another_message_is_a_fault_of_the_graph(use: str) -> None:
    text = (GRAPH % ("/imu", "sensor_msgs/msg/Image")).replace(":Imu'", f":{use}'")
    with pytest.raises(GraphError, match=r"type.*sensor_msgs/msg/Imu|type.*tf2_msgs/msg/TFMessage"):
        load_text(text)


def test_the_types_of_a_source_are_those_that_become_its_messages() -> None:
    for name, (becomes, _) in CONVERSIONS.items():
        getattr(topics, becomes.__name__)(topic="/a", type=name)
