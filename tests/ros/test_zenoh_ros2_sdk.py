"""Topics in both directions against zenoh-ros2-sdk, which others wrote, through a Zenoh router on loopback."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_peer import Read, router, until

import dataflow.ros as topics
from dataflow.interop.ros import CONVERSIONS
from dataflow.messages import Image, Text
from dataflow.ros.definitions import store_of, type_hash
from dataflow.ros.sink import Ros2Sink

sdk = pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk is not installed: pip install zenoh-ros2-sdk")
pytestmark = pytest.mark.network

STRING, IMAGE, IMU = "std_msgs/msg/String", "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"
DISTROS = ("jazzy", "kilted", "lyrical")


def definitions(type_: str, distro: Any) -> dict[str, str]:
    """The text of a type and of all that it is made of, by type."""
    text, _ = store_of(distro).generate_msgdef(type_, ros_version=2)
    first, *others = re.split(r"^=+\nMSG: (\S+)\n", text, flags=re.MULTILINE)
    named = {name.replace("/", "/msg/"): body for name, body in zip(others[::2], others[1::2], strict=True)}
    return {type_: first} | named


@pytest.fixture
def endpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """A router, and how the other side reaches it. Its definitions are files: it would fetch them with git."""
    from zenoh_ros2_sdk import message_registry
    from zenoh_ros2_sdk.session import ZenohSession

    for type_ in (IMAGE, IMU):
        for name, text in definitions(type_, "jazzy").items():
            file = tmp_path / f"{name}.msg"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
    monkeypatch.setattr(message_registry, "_registry", message_registry.MessageRegistry(str(tmp_path)))
    monkeypatch.setenv("ZENOH_CONFIG_OVERRIDE", 'mode="client"')
    with router() as found:
        host, port = found.removeprefix("tcp/").split(":")
        yield {"router": found, "there": {"router_ip": host, "router_port": int(port)}}
        if ZenohSession._instance is not None:
            ZenohSession._instance.close()


@pytest.mark.parametrize("distro", DISTROS)
def test_type_hashes_are_those_of_another_implementation(distro: Any) -> None:
    from zenoh_ros2_sdk.utils import get_type_hash

    mapped = [type_ for type_ in CONVERSIONS if type_hash(type_, distro) is not None]
    assert len(mapped) > 40
    for type_ in mapped:
        parts = definitions(type_, distro)
        text = parts.pop(type_)
        assert get_type_hash(type_, msg_definition=text, dependencies=parts) == type_hash(type_, distro), type_


def test_messages_of_a_ros2_publisher_arrive_and_losses_are_counted(endpoint: dict[str, Any]) -> None:
    talker = sdk.ROS2Publisher("/chatter", STRING, "string data\n", node_name="talker", **endpoint["there"])
    with Read(topics.Text(topic="/chatter", router=endpoint["router"])) as read:  # type and hash from its token
        until(lambda: talker.pub.matching_status.matching)
        for text in "ab":
            talker.publish(data=text)
        talker.sequence_number += 3
        talker.publish(data="f")
        until(lambda: len(read.steps) == 3)
        assert read.texts == ["a", "b", "f"]
        assert (read.source.summary()["lost"], read.source.summary()["received"]) == (3, 3)
    talker.close()


def test_published_messages_arrive_at_the_ros2_subscriber(endpoint: dict[str, Any]) -> None:
    said, seen = list[Any](), list[Any]()
    chatter = sdk.ROS2Subscriber("/chatter", STRING, said.append, "string data\n", **endpoint["there"])
    images = sdk.ROS2Subscriber("/camera", IMAGE, seen.append, **endpoint["there"])
    data = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    given = (
        ("/chatter", STRING, Text(stamp=7, text="hello")),
        ("/camera", IMAGE, Image(stamp=5, frame="c", data=data)),
    )
    for topic, type_, message in given:
        sink = Ros2Sink(topic=topic, type=type_, router=endpoint["router"])
        sink.setup()
        assert sink._publisher is not None
        until(lambda sink=sink: sink._publisher._publisher.matching_status.matching)
        sink.process(message, None)
        until(lambda came=said if type_ == STRING else seen: len(came) == 1)
        sink.close()
    assert said[0].data == "hello"
    assert (seen[0].header.stamp.nanosec, seen[0].header.frame_id, seen[0].encoding) == (5, "c", "rgb8")
    assert np.array_equal(seen[0].data.reshape(4, 5, 3), data)
    chatter.close()
    images.close()


def test_late_ros2_subscriber_receives_the_latched_message(endpoint: dict[str, Any]) -> None:
    from zenoh_ros2_sdk.qos import QosDurability, QosProfile

    sink = Ros2Sink(topic="/robot_description", type=STRING, router=endpoint["router"], durability="transient_local")
    sink.setup()
    sink.process(Text(stamp=1, text="<robot/>"), None)
    came = list[Any]()
    latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL)
    late = sdk.ROS2Subscriber(
        "/robot_description", STRING, came.append, "string data\n", qos=latched, **endpoint["there"]
    )
    until(lambda: len(came) == 1)
    assert came[0].data == "<robot/>"
    late.close()
    sink.close()
