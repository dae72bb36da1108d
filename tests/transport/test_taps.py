"""Taps: viewers get what they can take, in order, and no viewer costs a producer anything."""

from __future__ import annotations

import os
import random
import signal
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from transport_envelopes import carrying

from dataflow.messages import DepthImage
from dataflow.transport import Bus, Envelope, TapClient, TapServer, TapWindow, decode, encode
from dataflow.transport.keys import runtime_key
from dataflow.transport.taps import ACKNOWLEDGEMENT, ATTACHMENT

DEPTH = "robot1/camera/depth"
SCAN = "robot1/lidar/scan"


def envelope(seq: int, stream: str = DEPTH, side: int = 4) -> Envelope:
    data = np.full((side, side), seq, np.float32)
    return carrying(DepthImage(stamp=seq, frame="camera", data=data), stream, seq)


@pytest.fixture
def server(pair: tuple[Bus, Bus]) -> Any:
    with TapServer(pair[0], "robot1") as server:
        yield server


def taken(client: TapClient, timeout: float = 0.3) -> list[tuple[str, int]]:
    """(stream, seq) of everything that arrives until nothing more does."""
    found = []
    while (message := client.take(timeout)) is not None:
        found.append((message.stream, message.decode().seq))
    return found


def test_without_taps_an_offer_does_nothing(server: TapServer) -> None:
    class Untouchable:
        def __getattribute__(self, name: str) -> Any:
            raise AssertionError("an offer without taps looked at the message")

    assert not server.active
    server.offer(DEPTH, Untouchable())
    assert server.counters() == {"taps": 0, "sent": 0, "skipped": 0, "malformed": 0}


def test_a_tap_gets_the_streams_it_named_in_order(
    pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None]
) -> None:
    with TapClient(pair[1], "robot1", ["robot1/camera/*"]) as client:
        eventually(lambda: server.active)
        for seq in range(20):
            server.offer(DEPTH, envelope(seq))
            server.offer(SCAN, envelope(seq, SCAN))
        assert taken(client) == [(DEPTH, seq) for seq in range(20)]
        assert client.skipped == 0
    eventually(lambda: not server.active)


def test_beyond_the_window_the_newest_message_of_each_stream_waits(
    pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None]
) -> None:
    with TapClient(pair[1], "robot1", ["robot1/**"], TapWindow(messages=4)) as client:
        eventually(lambda: server.active)
        for seq in range(4):
            server.offer(DEPTH, envelope(seq))
        eventually(lambda: server.counters()["sent"] == 4)
        for seq in range(4, 100):
            server.offer(DEPTH, envelope(seq))
            server.offer(SCAN, envelope(seq, SCAN))
        assert server.counters()["sent"] == 4
        got = taken(client)
        assert got[:4] == [(DEPTH, seq) for seq in range(4)]
        assert set(got[4:]) == {(DEPTH, 99), (SCAN, 99)}
        assert server.counters()["skipped"] == 95 + 95
        server.offer(DEPTH, envelope(100))
        assert taken(client) == [(DEPTH, 100)]
        assert client.skipped == 190
        assert client.refused == 0


def test_byte_window_bounds_messages_in_flight_but_admits_one(
    pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None]
) -> None:
    with TapClient(pair[1], "robot1", ["robot1/**"], TapWindow(bytes=1000)) as client:
        eventually(lambda: server.active)
        for seq in range(10):
            server.offer(DEPTH, envelope(seq, side=64))
            eventually(lambda: server.counters()["sent"] == 1)
        got = taken(client)
        assert got[0] == (DEPTH, 0)
        assert got[-1] == (DEPTH, 9)
        assert client.refused == 0


def test_statics_come_first(pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None]) -> None:
    pair[0].declare_static("robot1/camera/info", encode(envelope(0, "robot1/camera/info")))
    pair[0].declare_static("robot1/lidar/info", encode(envelope(0, "robot1/lidar/info")))
    eventually(lambda: len(pair[1].query_static("robot1", timeout=0.5)) == 2)
    with TapClient(pair[1], "robot1", ["robot1/camera/*"]) as client:
        eventually(lambda: server.active)
        server.offer(DEPTH, envelope(7))
        assert taken(client) == [("robot1/camera/info", 0), (DEPTH, 7)]


def test_a_stopped_viewer_costs_neither_the_producer_nor_a_lossless_consumer_anything(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    producer = open_bus(listen=(endpoint,))
    consumer = open_bus(connect=(endpoint,))
    lossless: deque[Any] = deque()
    consumer.session.declare_subscriber(DEPTH, lambda sample: lossless.append(bytes(sample.payload)))
    publisher = producer.publisher(DEPTH)
    eventually(lambda: publisher.matched)
    with TapServer(producer, "robot1") as server:
        viewer = peer("tap", endpoint, "8")
        viewer.expect("up")
        eventually(lambda: server.active)
        os.kill(viewer.pid, signal.SIGSTOP)
        for seq in range(400):  # 26 MB: far more than any socket buffer
            item = envelope(seq, side=128)
            publisher.put(encode(item))
            server.offer(DEPTH, item)
        eventually(lambda: len(lossless) == 400)
        assert [decode(p).seq for p in lossless] == list(range(400))
        assert server.counters()["sent"] <= 8
        os.kill(viewer.pid, signal.SIGCONT)
        latest = 0
        while latest != 399:
            latest = viewer.expect("took")["seq"]
        assert server.counters()["sent"] + server.counters()["skipped"] == 400


def test_a_killed_viewer_is_forgotten(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    producer = open_bus(listen=(endpoint,))
    with TapServer(producer, "robot1") as server:
        viewer = peer("tap", endpoint, "8")
        viewer.expect("up")
        eventually(lambda: server.active)
        viewer.kill()
        eventually(lambda: not server.active, timeout=5.0)


def test_messages_dropped_by_zenoh_leave_the_window_free(
    pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None]
) -> None:
    with TapClient(pair[1], "robot1", ["robot1/**"], TapWindow(messages=2)) as client:
        eventually(lambda: server.active)
        put, server._put = server._put, lambda *_: None
        server.offer(DEPTH, envelope(0))
        server.offer(DEPTH, envelope(1))
        eventually(lambda: server.counters()["sent"] == 2)
        server._put = put
        server.offer(DEPTH, envelope(2))
        arrived = client.take(timeout=5.0)
        assert arrived is not None
        assert arrived.head().seq == 2


def test_the_newest_of_a_stream_is_sent_again_when_zenoh_dropped_it(
    pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dataflow.transport.tap_server.SYNC_EVERY", 0.05)
    with TapClient(pair[1], "robot1", ["robot1/**"], TapWindow(messages=4)) as client:
        eventually(lambda: server.active)
        put, server._put = server._put, lambda *_: None
        server.offer(SCAN, envelope(0, SCAN))
        server.offer(DEPTH, envelope(0))
        server.offer(DEPTH, envelope(1))
        eventually(lambda: server.counters()["sent"] == 3)
        server._put = put
        assert sorted(taken(client)) == [(DEPTH, 1), (SCAN, 0)]
        counters = server.counters()
        assert (counters["sent"], counters["skipped"]) == (2, 1)
        assert client.refused == 0


@pytest.mark.parametrize("seed", range(6))
def test_streams_with_drops_stay_ordered_and_keep_their_last_message(
    pair: tuple[Bus, Bus],
    server: TapServer,
    eventually: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    seed: int,
) -> None:
    monkeypatch.setattr("dataflow.transport.tap_server.SYNC_EVERY", 0.02)
    chance = random.Random(seed)
    put = server._put
    server._put = lambda *a: None if chance.random() < 0.4 else put(*a)
    with TapClient(pair[1], "robot1", ["robot1/**"], TapWindow(messages=4)) as client:
        eventually(lambda: server.active)
        got: dict[str, list[int]] = {DEPTH: [], SCAN: []}
        for seq in range(40):
            server.offer(DEPTH, envelope(seq))
            server.offer(SCAN, envelope(seq, SCAN))
            if chance.random() < 0.5 and (message := client.take(0.01)) is not None:
                got[message.stream].append(message.decode().seq)
        while any(seqs[-1:] != [39] for seqs in got.values()):
            message = client.take(timeout=10.0)
            assert message is not None
            got[message.stream].append(message.decode().seq)
        assert all(seqs == sorted(set(seqs)) for seqs in got.values())
        eventually(lambda: server.counters()["sent"] == len(got[DEPTH]) + len(got[SCAN]))
        assert server.counters()["sent"] + server.counters()["skipped"] == 80
        assert client.refused == 0


def test_malformed_requests_and_acknowledgements_are_counted_and_ignored(
    pair: tuple[Bus, Bus], server: TapServer, eventually: Callable[..., None]
) -> None:
    first, second = pair
    with TapClient(second, "robot1", ["robot1/**"], TapWindow(messages=4)) as client:
        eventually(lambda: server.active)
        ack = second.publisher(runtime_key("robot1", "ack", first.id, client.id))
        for seq in range(4):
            server.offer(DEPTH, envelope(seq))
        eventually(lambda: server.counters()["sent"] == 4)
        for payload in (b"", b"x" * 20, ACKNOWLEDGEMENT.pack(1, 1000, 10**9), ACKNOWLEDGEMENT.pack(77, 4, 400)):
            ack.put(payload)
        eventually(lambda: server.counters()["malformed"] == 1)
        server.offer(DEPTH, envelope(4))
        forged = second.session
        forged.put(runtime_key("robot1", "tap", client.id, "camera", "depth"), b"x")
        forged.put(
            runtime_key("robot1", "tap", client.id, "camera", "depth"),
            b"x",
            attachment=ATTACHMENT.pack(b"y" * 16, 1, 1000, 1000, 0),
        )
        eventually(lambda: client.refused == 2)
        assert taken(client) == [(DEPTH, seq) for seq in range(5)]


def test_expressions_and_windows_are_checked(pair: tuple[Bus, Bus]) -> None:
    with pytest.raises(ValueError, match="expressions"):
        TapClient(pair[1], "robot1", ["robot1//camera"])
    with pytest.raises(ValueError, match="1 to 64 expressions"):
        TapClient(pair[1], "robot1", [])
    with pytest.raises(ValueError, match="window"):
        TapWindow(messages=0)
