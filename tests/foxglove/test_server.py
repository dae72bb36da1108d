"""A Foxglove client sees streams, a late panel the newest message; its playback bar moves the clock."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from made_bags import ROS1, SECOND, ros, write_ros1
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from dataflow.foxglove.player import Clock
from dataflow.foxglove.server import FoxgloveError, FoxgloveServer
from dataflow.messages import Detections2D, Number, Odometry

pytest.importorskip("foxglove", reason="foxglove-sdk comes with the extra [foxglove]")

WITHIN = 60.0
STAMP = 1_700_000_000 * 10**9


class Client:
    """Speaks the protocol of https://github.com/foxglove/ws-protocol."""

    def __init__(self, address: str) -> None:
        self._closing = contextlib.ExitStack()
        self._socket = self._closing.enter_context(connect(address, subprotocols=["foxglove.sdk.v1"]))
        self.said: queue.Queue[dict[str, Any]] = queue.Queue()
        self.data: queue.Queue[tuple[int, int, bytes]] = queue.Queue()
        self.other: queue.Queue[tuple[int, bytes]] = queue.Queue()
        self.channels: dict[str, dict[str, Any]] = {}
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):  # this server cuts the connection instead of closing it
            for message in self._socket:
                if isinstance(message, str):
                    self.said.put(said := json.loads(message))
                    if "unknown channel" in said.get("message", "").lower():  # it was advertised a moment too early
                        self._socket.send(json.dumps(self._asked))
                elif message[0] == 1:
                    subscription, stamp = struct.unpack_from("<IQ", message, 1)
                    self.data.put((subscription, stamp, message[13:]))
                else:
                    self.other.put((message[0], message[1:]))

    def channel(self, topic: str) -> dict[str, Any]:
        """Waits until a topic is advertised."""
        while topic not in self.channels:
            said = self.said.get(timeout=WITHIN)
            if said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        return self.channels[topic]

    def subscribe(self, topic: str, subscription: int) -> None:
        wanted = {"id": subscription, "channelId": self.channel(topic)["id"]}
        self._asked = {"op": "subscribe", "subscriptions": [wanted]}
        self._socket.send(json.dumps(self._asked))

    def request(self, *, playing: bool, speed: float, seek: int | None) -> None:
        head = struct.pack("<BBfBQI", 3, 0 if playing else 1, speed, seek is not None, seek or 0, 2)
        self._socket.send(head + b"r1")

    def close(self) -> None:
        self._closing.close()
        self._reader.join(WITHIN)


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with FoxgloveServer("test", namespace="robot1", port=0) as opened:
        yield opened


@pytest.fixture
def client(server: FoxgloveServer) -> Iterator[Client]:
    opened = Client(server.address)
    yield opened
    opened.close()


def found(seq: int) -> Detections2D:
    return Detections2D(
        stamp=STAMP + seq, frame="camera", width=64, height=48, class_names=("cup",),
        boxes=np.array([[1, 2, 11, 12]], np.float32), scores=np.array([0.5], np.float32),
        class_ids=np.zeros(1, np.int32),
    )  # fmt: skip


def test_opened_panel_receives_the_newest_and_later_messages(server: FoxgloveServer, client: Client) -> None:
    server.show("robot1/detector/found", found(0))
    client.subscribe("/detector/found", 7)
    subscription, stamp, data = client.data.get(timeout=WITHIN)
    server.show("robot1/detector/found", found(1))
    _, later, _ = client.data.get(timeout=WITHIN)

    assert (subscription, stamp, later) == (7, STAMP, STAMP + 1)
    assert client.channel("/detector/found")["schemaName"] == "foxglove.ImageAnnotations"
    annotations = ImageAnnotations.FromString(data)
    assert annotations.texts[0].text == "cup 0.50"
    assert [(p.x, p.y) for p in annotations.points[0].points] == [(1, 2), (11, 2), (11, 12), (1, 12)]


def test_an_odometry_places_its_frame(server: FoxgloveServer, client: Client) -> None:
    pose = Odometry(
        stamp=STAMP, frame="odom", child_frame="base", position=np.array([1.0, 2.0, 3.0]),
        orientation=np.array([0.0, 0.0, 0.0, 1.0]), linear=np.zeros(3), angular=np.zeros(3),
    )  # fmt: skip
    server.show("robot1/odometry/pose", pose)
    client.subscribe("/odometry/pose", 1)
    client.subscribe("/frames", 2)
    shown = {subscription: data for subscription, _, data in (client.data.get(timeout=WITHIN) for _ in range(2))}

    assert PoseInFrame.FromString(shown[1]).pose.position.z == 3.0
    placed = FrameTransforms.FromString(shown[2]).transforms[0]
    assert (placed.parent_frame_id, placed.child_frame_id, placed.translation.y) == ("odom", "base", 2.0)


def test_a_type_without_a_schema_of_foxglove_is_sent_as_json(server: FoxgloveServer, client: Client) -> None:
    server.show("robot1/gauge/value", Number(stamp=STAMP, value=2.5))
    client.subscribe("/gauge/value", 1)

    assert json.loads(client.data.get(timeout=WITHIN)[2])["value"] == 2.5


def test_the_playback_bar_moves_the_clock() -> None:
    clock = Clock(STAMP, STAMP + 10**10)
    with FoxgloveServer("test", port=0, controls=clock, span=(clock.first, clock.last)) as server:
        client = Client(server.address)
        info = client.said.get(timeout=WITHIN)
        client.request(playing=False, speed=2.0, seek=STAMP + 5 * 10**9)
        opcode, body = client.other.get(timeout=WITHIN)
        client.close()

    assert "playbackControl" in info["capabilities"]
    assert clock.state() == (False, STAMP + 5 * 10**9, 2.0)
    assert opcode == 5
    status, current, speed, did_seek = struct.unpack_from("<BQfB", body)
    assert (status, current, speed, did_seek) == (1, STAMP + 5 * 10**9, 2.0, 1)


def test_a_refused_seek_moves_nothing_and_is_reported() -> None:
    class Fixed(Clock):
        def request(self, *, playing: bool, speed: float, seek: int | None) -> str | None:
            return "no jumps here" if seek is not None else None

    clock = Fixed(STAMP, STAMP + 10**10)
    with FoxgloveServer("test", port=0, controls=clock, span=(clock.first, clock.last)) as server:
        client = Client(server.address)
        client.request(playing=True, speed=1.0, seek=STAMP + 5 * 10**9)
        _, body = client.other.get(timeout=WITHIN)
        while (said := client.said.get(timeout=WITHIN))["op"] != "status":
            pass
        client.close()

    assert (said["level"], said["message"]) == (1, "no jumps here")
    _, current, _, did_seek = struct.unpack_from("<BQfB", body)
    assert (current, did_seek) == (STAMP, 0)


@contextmanager
def playing(*options: str) -> Iterator[Client]:
    """A client of `dataflow foxglove`, which ends in order when it is interrupted."""
    command = [sys.executable, "-m", "dataflow.cli.main", "foxglove", *options, "--port", "0"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        client = Client(next(line.split()[-1] for line in process.stderr if "ws://" in line))
        yield client
        client.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(WITHIN) == 0
    finally:
        process.kill()
        process.wait(WITHIN)
        process.stderr.close()


def test_the_command_plays_a_recording_until_it_is_interrupted(repository: Path) -> None:
    with playing(str(repository / "recordings" / "demo.mcap"), "--start", "2") as client:
        client.subscribe("/robot/image_jpeg", 1)
        _, stamp, data = client.data.get(timeout=WITHIN)

    assert stamp > 0
    assert CompressedImage.FromString(data).format == "jpeg"


def test_a_bag_is_played_as_a_recording_is(tmp_path: Path) -> None:
    text = ros("std_msgs/String", ROS1, data="hello")
    bag = write_ros1(tmp_path / "old.bag", [("/said", STAMP + k * SECOND // 10, text) for k in range(20)])
    with playing(str(bag)) as client:
        client.subscribe("/said", 1)
        said = json.loads(client.data.get(timeout=WITHIN)[2])

    assert said["text"] == "hello"


def test_a_port_in_use_is_named(server: FoxgloveServer) -> None:
    port = int(server.address.rpartition(":")[2])
    with pytest.raises(FoxgloveError, match=f"cannot listen on 127.0.0.1:{port}"):
        FoxgloveServer("second", port=port)
