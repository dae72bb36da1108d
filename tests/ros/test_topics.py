"""Topics of a hand-made ROS peer in and out of graphs, through a Zenoh router on loopback."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import zenoh.ext
from ros_peer import HUMBLE, JAZZY, STRING, Peer, Read, ros, router, string, until

import dataflow.ros as topics
from dataflow.graph import GraphError, load_text
from dataflow.messages import CameraInfo, Image, Text, Twist
from dataflow.operator import FINDING, SourceError
from dataflow.recording import Recording
from dataflow.ros import source as source_module
from dataflow.ros.node import Ros2Node
from dataflow.ros.sink import Ros2Sink
from dataflow.supervision.core.report import RunReport
from dataflow.supervision.plan import LogPlan, RunPlan, process_plans
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.verify import verify

pytestmark = pytest.mark.network

TF, IMAGE = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/Image"
OF_STRINGS = "0/chatter/std_msgs::msg::dds_::String_"


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with router() as found:
        yield found


@pytest.fixture
def peer(endpoint: str) -> Iterator[Peer]:
    with Peer(endpoint) as found:
        yield found


def read(name: str, peer: Peer, **params: Any) -> Read:
    """A source of a topic, once what is sent comes."""
    found = Read(getattr(topics, name)(router=peer.endpoint, **params))
    until(lambda: peer.tokens(f"@ros2_lv/0/{found.source._node.node.session}/*/*/MS/**"))
    return found


def header(nanoseconds: int, frame: str = "camera") -> Any:
    seconds, rest = divmod(nanoseconds, 10**9)
    stamp = ros("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
    return ros("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def transform(child: str, stamp: int = 5 * 10**9) -> Any:
    vector = ros("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    turn = ros("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    place = ros("geometry_msgs/msg/Transform", translation=vector, rotation=turn)
    row = ros("geometry_msgs/msg/TransformStamped", header=header(stamp, "base"), child_frame_id=child, transform=place)
    return ros(TF, transforms=[row])


def image(stamp: int, value: int) -> Any:
    rows = {"encoding": "rgb8", "is_bigendian": 0, "step": 192, "data": np.full(48 * 192, value, np.uint8)}
    return ros(IMAGE, header=header(stamp), height=48, width=64, **rows)


def test_messages_come_in_order_and_every_loss_is_counted(endpoint: str, peer: Peer) -> None:
    talker = peer.publisher("/chatter", "std_msgs/msg/String", STRING)
    with read("Text", peer, topic="chatter") as reading:
        for text in "ab":
            talker.send(string(text))
        talker.number += 3
        talker.send(string("f"))
        until(lambda: len(reading.steps) == 3)
        other = peer.publisher("/chatter", "std_msgs/msg/String", STRING)  # it was started anew
        other.send(string("g"))
        until(lambda: len(reading.steps) == 4)
    assert reading.texts == ["a", "b", "f", "g"]
    assert [(step["lost"].value, step["message"].text) for step in reading.steps if "lost" in step] == [(3, "f")]
    summary = reading.source.summary()
    assert (summary["lost"], summary["received"], summary["overflow"]) == (3, 4, 0)
    assert reading.source.finding() == "/chatter: lost are 3 of 6 messages of /talker"


def test_a_publisher_of_another_distribution_is_named(
    endpoint: str, peer: Peer, caplog: pytest.LogCaptureFixture
) -> None:
    with read("Text", peer, topic="/chatter", type="std_msgs/msg/String", distro="kilted") as reading:
        old = peer.publisher("/chatter", "std_msgs/msg/String", HUMBLE)
        numbers = peer.publisher("/chatter", "std_msgs/msg/Float64", JAZZY.hash_rihs01("std_msgs/msg/Float64"))
        old.send(string("unheard"))
        until(lambda: reading.source.summary().get("mismatched") == 2)
    said = caplog.text
    assert "/talker publishes std_msgs/msg/String as defined by humble (TypeHashNotSupported)" in said
    assert "/talker publishes std_msgs/msg/Float64, and std_msgs/msg/String is taken" in said
    assert "as defined by humble" in reading.source.finding()
    assert not reading.steps
    assert numbers.number == 0


@pytest.mark.parametrize("hash_", [HUMBLE, STRING])
def test_type_and_distribution_are_those_of_the_publisher_unless_given(endpoint: str, peer: Peer, hash_: str) -> None:
    talker = peer.publisher("/found", "std_msgs/msg/String", hash_)
    with read("Text", peer, topic="/found") as reading:
        talker.send(string("heard"))
        until(lambda: reading.texts == ["heard"])


def test_types_without_a_counterpart_are_passed_on_as_they_are(endpoint: str, peer: Peer) -> None:
    own = "RIHS01_" + "7" * 64
    talker = peer.publisher("/gripper", "my_robot/msg/Gripper", own)
    key = f"0/again/my_robot::msg::dds_::Gripper_/{own}"
    came = peer.heard(key)
    sink = Ros2Sink(topic="/again", router=endpoint)
    sink.setup()
    with read("Ros2Source", peer, topic="/gripper") as reading:
        talker.send(b"\0\1\0\0abc")
        until(lambda: len(reading.steps) == 1)
    got = reading.steps[0]["message"]
    assert (got.type, got.hash, got.data.tobytes()) == ("my_robot/msg/Gripper", own, b"\0\1\0\0abc")
    sink.process(got, None)
    until(lambda: peer.tokens("@ros2_lv/0/*/*/*/MP/*/*/*/%again/**"))
    sink.process(got, None)
    until(lambda: came)
    assert came[-1].payload.to_bytes() == b"\0\1\0\0abc"
    sink.close()
    with pytest.raises(SourceError, match="defines my_robot/msg/Gripper as no distribution"):
        topics.Imu(topic="/gripper", router=endpoint).setup()


def test_late_subscriber_receives_latched_messages_of_both_publishers(endpoint: str, peer: Peer) -> None:
    with Peer(endpoint, "second") as second:
        hash_ = JAZZY.hash_rihs01(TF)
        one, two = (each.publisher("/tf_static", TF, hash_, latched=1) for each in (peer, second))
        one.send(transform("lidar"))
        two.send(transform("camera"))
        for _ in range(5):
            source = topics.StaticTransforms(topic="/tf_static", router=endpoint)
            source.setup()
            held = source.static_outputs()["message"]
            source.close()
            assert sorted(held.child_frames) == ["camera", "lidar"]
            assert source.summary()["lost"] == 0


def test_latched_messages_reach_late_ros_subscribers(endpoint: str, peer: Peer) -> None:
    sink = Ros2Sink(
        topic="notice", namespace="/robot", router=endpoint, durability="transient_local", depth=1, node="dash"
    )
    sink.setup()
    for text in ("old", "new"):
        sink.process(Text(stamp=1, text=text), None)
    kind = "std_msgs/msg/String"
    key = f"0/robot/notice/std_msgs::msg::dds_::String_/{STRING}"
    for _ in range(5):
        late = peer.heard(key, history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1))
        until(lambda late=late: late and JAZZY.deserialize_cdr(late[-1].payload.to_bytes(), kind).data == "new")
        attachment = late[-1].attachment.to_bytes()
        assert (len(attachment), attachment[:8], attachment[16]) == (33, bytes([2, 0, 0, 0, 0, 0, 0, 0]), 16)
    (token,) = peer.tokens("@ros2_lv/0/*/*/*/MP/*/*/*/%robot%notice/**")
    assert token.endswith(f"/MP/%/%robot/dash/%robot%notice/std_msgs::msg::dds_::String_/{STRING}/:1:,1:,:,:,,")
    sink.close()


def test_a_command_goes_out_as_the_type_that_the_robot_takes(endpoint: str, peer: Peer) -> None:
    kind = "geometry_msgs/msg/Twist"
    came = peer.heard(f"0/cmd_vel/geometry_msgs::msg::dds_::Twist_/{JAZZY.hash_rihs01(kind)}")
    sink = Ros2Sink(topic="/cmd_vel", type=kind, router=endpoint)
    sink.setup()
    until(lambda: peer.tokens("@ros2_lv/0/*/*/*/MP/*/*/*/%cmd_vel/**"))
    sink.process(Twist(stamp=5, frame="base", linear=(0.5, 0, 0), angular=(0, 0, 1)), None)
    until(lambda: came)
    assert JAZZY.deserialize_cdr(came[0].payload.to_bytes(), kind).linear.x == 0.5
    sink.close()


def test_messages_without_a_header_are_stamped_by_the_clock_of_ros(endpoint: str, peer: Peer) -> None:
    talker = peer.publisher("/simulated", "std_msgs/msg/String", STRING)
    clock = peer.publisher("/clock", "rosgraph_msgs/msg/Clock", JAZZY.hash_rihs01("rosgraph_msgs/msg/Clock"))
    with read("Text", peer, topic="/simulated", sim_time=True) as reading:
        talker.send(string("before"))
        until(lambda: reading.source.summary().get("before_clock") == 1)
        for second in (7, 8):
            clock.send(ros("rosgraph_msgs/msg/Clock", clock=ros("builtin_interfaces/msg/Time", sec=second, nanosec=1)))
            until(lambda second=second: reading.source._mail.clock == second * 10**9 + 1)
            for _ in range(3):
                talker.send(string("after"))
            until(lambda second=second: len(reading.steps) == 3 * (second - 6))
        clock.send(b"\0\1")
        until(lambda: reading.source.summary().get("unreadable") == 1)
    assert [step["message"].stamp for step in reading.steps] == [
        second * 10**9 + k for second in (7, 8) for k in (1, 2, 3)
    ]
    assert reading.source.summary()["late"] == 0
    assert reading.source.finding().startswith("/clock: a rosgraph_msgs/msg/Clock of 2 bytes is too short")


def test_a_message_that_cannot_be_read_is_counted_with_its_reason(endpoint: str, peer: Peer) -> None:
    talker = peer.publisher("/broken", "sensor_msgs/msg/Imu", JAZZY.hash_rihs01("sensor_msgs/msg/Imu"))
    with read("Imu", peer, topic="/broken") as reading:
        talker.send(b"\0\1\0\0\1")
        until(lambda: reading.source.summary().get("unreadable") == 1)
    assert "sensor_msgs/msg/Imu" in reading.source.finding()


def test_the_number_of_losses_comes_again_since_a_step_may_be_refused(endpoint: str, peer: Peer) -> None:
    talker = peer.publisher("/chatter", "std_msgs/msg/String", STRING)
    with read("Text", peer, topic="/chatter", type="std_msgs/msg/String") as reading:
        talker.send(string("0"))
        talker.number += 3
        for text in range(1, 50):
            talker.send(string(str(text)))
        until(lambda: len(reading.steps) == 50)
    found = [(step["message"].text, step["lost"].value) for step in reading.steps if "lost" in step]
    assert found == [("1", 3), ("21", 3), ("41", 3)]


def test_definitions_are_read_before_messages_come(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[tuple[str, str]] = []
    monkeypatch.setattr(source_module, "distros_of", lambda *of: read.append(of))
    monkeypatch.setattr(Ros2Node, "subscribe", lambda *_: read.append(("", "subscribed")))
    source = topics.Text(topic="/chatter", type="std_msgs/msg/String", router=endpoint)
    source.setup()
    source.close()
    assert read == [("std_msgs/msg/String", STRING), ("", "subscribed")]


def test_errors_name_the_missing_publisher_type_or_message(endpoint: str, peer: Peer) -> None:
    talker = peer.publisher("/chatter", "std_msgs/msg/String", STRING)
    with pytest.raises(SourceError, match=r"no publisher of /scan in domain 0 within 0.2 s; topics there: .*/chatter"):
        topics.LaserScan(topic="/scan", router=endpoint, within="200ms").setup()
    with pytest.raises(SourceError, match="no type 'my_robot/msg/Gripper' that is known here"):
        topics.Ros2Source(topic="/gripper", type="my_robot/msg/Gripper", router=endpoint).setup()
    source = topics.StaticText(topic="/chatter", router=endpoint, within="200ms")
    source.setup()
    with pytest.raises(SourceError, match=r"std_msgs/msg/String.* came within 0\.2 s; its publishers: /talker"):
        source.static_outputs()
    source.close()
    with pytest.raises(GraphError, match="has no operator 'Imag'"):
        load_text("graph: g\noperators:\n  a: {use: 'dataflow.ros:Imag', params: {topic: /a}}\n")
    assert talker.number == 0


GRAPH = """
graph: robot
operators:
  camera: {use: "dataflow.ros:Image", params: {topic: /camera/image, router: "%s"}}
  fixed: {use: "dataflow.ros:StaticTransforms", params: {topic: /tf_static, router: "%s"}}
  half: {use: "ros_operators:Half", inputs: {image: camera/message}, live: {queue: block}}
  out:
    use: "dataflow.ros:Ros2Sink"
    inputs: {message: half/half, fixed: fixed/message}
    params: {topic: /half, fixed_topic: /kept, router: "%s"}
    live: {queue: block}
"""


class Live:
    """A live run on a thread, until it is to end."""

    def __init__(self, text: str, record: Path) -> None:
        self.graph = load_text(text)
        self.supervisor = Supervisor(RunPlan(self.graph, live=True, record=record, metadata={}))
        self.reports: list[RunReport] = []
        self.thread = threading.Thread(target=lambda: self.reports.append(self.supervisor.run()))
        self.thread.start()

    def end(self) -> RunReport:
        self.supervisor.stop()
        self.thread.join(60)
        return self.reports[0]


@pytest.mark.process
def test_a_live_graph_of_ros_topics_is_recorded_and_verified(endpoint: str, peer: Peer, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    fixed = peer.publisher("/tf_static", TF, JAZZY.hash_rihs01(TF), latched=1)
    fixed.send(transform("lidar"))
    hash_ = JAZZY.hash_rihs01(IMAGE)
    camera = peer.publisher("/camera/image", IMAGE, hash_)
    came = peer.heard(f"0/half/sensor_msgs::msg::dds_::Image_/{hash_}")
    live = Live(GRAPH % (endpoint, endpoint, endpoint), path)
    until(lambda: peer.tokens("@ros2_lv/0/*/*/*/MS/*/*/*/%camera%image/**"), 60)
    begin = time.time_ns()
    sent = 0
    while len(came) < 5:  # a run that has begun publishes
        camera.send(image(time.time_ns(), sent % 256))
        sent += 1
        time.sleep(0.05)
        assert time.time_ns() - begin < 60 * 10**9
    camera.number += 2
    camera.send(image(time.time_ns(), 200))
    until(lambda: came[-1].payload.to_bytes()[-1] == 200)
    late = peer.heard(
        f"0/kept/tf2_msgs::msg::dds_::TFMessage_/{JAZZY.hash_rihs01(TF)}",
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
    )
    until(lambda: late)
    report = live.end()
    verified = verify(path, graph=live.graph)

    assert report.summaries["camera"]["lost"] == 2
    assert "lost are 2 of" in report.summaries["camera"][FINDING]
    assert JAZZY.deserialize_cdr(late[0].payload.to_bytes(), TF).transforms[0].child_frame_id == "lidar"
    with Recording(path) as recording:
        images = [r.message for r in recording.messages(["robot/camera/message"])]
        lost = [r.message.value for r in recording.messages(["robot/camera/lost"])]
    assert lost == [2]
    assert isinstance(images[-1], Image)
    assert images[-1].data[0, 0, 0] == 200
    assert verified.identical, verified.as_json()
    assert [v.operator for v in verified.operators] == ["half"]


def test_a_replay_does_not_publish_again() -> None:
    graph = load_text(GRAPH % (("tcp/127.0.0.1:7447",) * 3))
    log = LogPlan(Path("run.mcap"), ("robot/camera/message", "robot/fixed/message"), finals={}, first=0)
    nodes = [node for plan in process_plans(RunPlan(graph, log=log)).values() for node in plan.nodes]
    assert nodes == ["half"]


def test_a_node_listens_nowhere(endpoint: str) -> None:
    def listening() -> set[Any]:
        return {
            c.laddr for c in psutil.Process().net_connections("inet") if c.status == psutil.CONN_LISTEN or not c.raddr
        }

    before = listening()
    sink = Ros2Sink(topic="/quiet", type="std_msgs/msg/String", router=endpoint)
    sink.setup()
    assert listening() == before
    sink.close()


def test_a_calibration_beside_images_goes_with_each_of_them_at_its_stamp(endpoint: str, peer: Peer) -> None:
    kind = "sensor_msgs/msg/CameraInfo"
    came = peer.heard(f"0/camera_info/sensor_msgs::msg::dds_::CameraInfo_/{JAZZY.hash_rihs01(kind)}")
    sink = Ros2Sink(topic="/image", fixed_topic="/camera_info", router=endpoint, depth=5)
    sink.setup()
    info = CameraInfo.from_intrinsics(stamp=0, frame="c", width=4, height=2, fx=3, fy=3, cx=2, cy=1)
    pixels = np.zeros((2, 4), np.uint8)
    sink.process(Image(stamp=7, frame="c", data=pixels), info)
    until(lambda: peer.tokens("@ros2_lv/0/*/*/*/MP/*/*/*/%camera_info/**"))
    for stamp in (8, 9):
        sink.process(Image(stamp=stamp, frame="c", data=pixels), info)

    def stamps() -> list[int]:
        return [JAZZY.deserialize_cdr(each.payload.to_bytes(), kind).header.stamp.nanosec for each in came]

    until(lambda: stamps()[-1:] == [9])
    assert stamps()[-2:] == [8, 9]
    sink.close()
