"""The bus to what is outside a run: order, no loss, statics, and nothing reachable from other machines."""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest
from transport_envelopes import carrying, depth_image

from dataflow.transport import (
    Bus,
    BusError,
    Envelope,
    Kind,
    NetworkConfig,
    NetworkError,
    decode,
    encode,
)
from dataflow.transport.network import is_local

DEPTH = "robot1/camera/depth"


def test_plain_subscriber_receives_all_messages_in_order(
    pair: tuple[Bus, Bus], eventually: Callable[..., None]
) -> None:
    first, second = pair
    seen: deque[Any] = deque()
    second.session.declare_subscriber(DEPTH, lambda sample: seen.append(decode(bytes(sample.payload))))
    publisher = first.publisher(DEPTH)
    eventually(lambda: publisher.matched)
    sent = [carrying(depth_image(i), DEPTH, i) for i in range(2000)]
    for envelope in sent:
        publisher.put(encode(envelope))
    eventually(lambda: len(seen) == len(sent))
    assert [(e.seq, e.message) for e in seen] == [(e.seq, e.message) for e in sent]
    assert first.counters()["published_messages"] == len(sent)


def test_publisher_reports_whether_it_has_subscribers(pair: tuple[Bus, Bus], eventually: Callable[..., None]) -> None:
    first, second = pair
    publisher = first.publisher(DEPTH)
    assert not publisher.matched
    subscriber = second.session.declare_subscriber("robot1/*/depth", lambda sample: None)
    eventually(lambda: publisher.matched)
    subscriber.undeclare()
    eventually(lambda: not publisher.matched)


def test_a_stopped_subscriber_blocks_its_publisher_for_a_bounded_time_and_sees_what_it_missed(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    bus = open_bus(listen=(endpoint,), blocked=0.2)
    consumer = peer("consume", endpoint)
    publisher = bus.publisher(DEPTH)
    eventually(lambda: publisher.matched)
    os.kill(consumer.pid, signal.SIGSTOP)
    seq = 0
    while not bus.counters()["stalled"]:
        publisher.put(encode(carrying(depth_image(seq, 128), DEPTH, seq)))
        seq += 1
    eventually(lambda: not bus.peers())
    for _ in range(100):  # nobody is waited for any more
        publisher.put(encode(carrying(depth_image(seq, 128), DEPTH, seq)))
        seq += 1
    assert bus.counters()["stalled"] == 1
    os.kill(consumer.pid, signal.SIGCONT)

    def ended() -> bool:
        publisher.put(encode(Envelope(Kind.END, DEPTH, 0, 0, seq)))
        return bool(consumer.waiting())

    eventually(ended)
    numbers = [number for kind, number, _ in consumer.expect("ended")["seen"] if kind == "MESSAGE"]
    assert numbers == sorted(set(numbers))
    assert len(numbers) < seq


def test_a_late_joiner_gets_the_static_streams_it_asks_for(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    producer = peer("live", endpoint)
    producer.expect("up")
    bus = open_bus(connect=(endpoint,))
    eventually(lambda: "robot1/camera/info" in bus.query_static("robot1", timeout=0.5))
    answered = bus.query_static("robot1", "robot1/*/info")
    message = decode(answered["robot1/camera/info"]).message
    assert message is not None
    assert message == depth_image(3)
    assert bus.query_static("robot1", "robot1/*/depth") == {}
    assert bus.query_static("robot2") == {}


def test_restarted_process_on_its_endpoint_is_reconnected(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    bus = open_bus(connect=(endpoint,))
    for _ in range(2):
        child = peer("live", endpoint)
        child.expect("up")
        eventually(lambda: len(bus.peers()) == 1)
        child.kill()
        eventually(lambda: not bus.peers(), timeout=5.0)


def test_wildcards_do_not_match_the_runtimes_own_keys(pair: tuple[Bus, Bus], eventually: Callable[..., None]) -> None:
    first, second = pair
    everything: list[str] = []
    runtime: list[str] = []
    for expression in ("**", "robot1/**", "robot1/*/*/*"):
        second.session.declare_subscriber(expression, lambda sample: everything.append(str(sample.key_expr)))
    second.session.declare_subscriber("robot1/@/**", lambda sample: runtime.append(str(sample.key_expr)))
    keys = ("robot1/@/firings/camera", "robot1/camera/depth")
    publishers = {key: first.publisher(key) for key in keys}

    def both_arrive() -> bool:
        for key in keys:
            publishers[key].put(b"x")
        return len(runtime) > 2 and len(everything) > 4

    eventually(both_arrive)
    assert set(runtime) == {"robot1/@/firings/camera"}
    assert set(everything) == {"robot1/camera/depth"}


def test_a_later_static_message_replaces_the_earlier(pair: tuple[Bus, Bus], eventually: Callable[..., None]) -> None:
    first, second = pair
    for stamp in (1, 2):
        first.declare_static("a/b/camera/info", encode(carrying(depth_image(stamp), "a/b/camera/info", 0)))
    eventually(lambda: bool(second.query_static("a/b", timeout=0.5)))
    assert decode(second.query_static("a/b")["a/b/camera/info"]).stamp == 2


def test_closing_ends_threads_and_further_use_is_refused(endpoint: str) -> None:
    before = threading.active_count()
    bus = Bus(NetworkConfig(listen=(endpoint,)))
    publisher = bus.publisher(DEPTH)
    bus.close()
    bus.close()
    assert threading.active_count() == before
    with pytest.raises(BusError, match="robot1/camera/depth"):
        publisher.put(b"x")


def test_an_interrupt_while_closing_takes_effect_when_it_is_closed(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = Bus(NetworkConfig(listen=(endpoint,)))
    session = bus.session
    closed: list[bool] = []

    class Interrupting:
        def close(self) -> None:
            for _ in range(3):
                signal.raise_signal(signal.SIGINT)
            session.close()
            closed.append(True)

    monkeypatch.setattr(bus, "session", Interrupting())
    with pytest.raises(KeyboardInterrupt):
        bus.close()
    assert closed == [True]
    assert session.is_closed()


def test_an_endpoint_in_use_is_an_error_that_names_it(open_bus: Callable[..., Bus], endpoint: str) -> None:
    open_bus(listen=(endpoint,))
    with pytest.raises(BusError, match=endpoint):
        open_bus(listen=(endpoint,))


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("tcp/127.0.0.1:0", True),
        ("tcp/[::1]:7447", True),
        ("tls/localhost:7447", True),
        ("unixsock-stream//run/user/1000/graph.sock", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:0", False),
        ("tcp/192.168.1.2:7447", False),
        ("tcp/robot.local:7447", False),
        ("tcp/127.0.0.1:0#iface=eth0", False),
    ],
)
def test_only_loopback_is_listened_on_unless_exposed(endpoint: str, local: bool) -> None:
    assert is_local(endpoint) == local
    if not local:
        with pytest.raises(NetworkError, match="can be reached from other machines"):
            NetworkConfig(listen=(endpoint,))
    assert NetworkConfig(listen=(endpoint,), exposed=True).listen == (endpoint,)
    assert NetworkConfig(connect=(endpoint,)).connect == (endpoint,)


def test_a_malformed_endpoint_or_setting_is_named() -> None:
    with pytest.raises(NetworkError, match=r"'127\.0\.0\.1:7447'"):
        NetworkConfig(listen=("127.0.0.1:7447",))
    with pytest.raises(NetworkError, match="no/such/setting"):
        NetworkConfig(zenoh={"no/such/setting": 1}).zenoh_config()


def test_reasons_name_no_file_of_a_library() -> None:
    with pytest.raises(BusError) as raised:
        Bus(NetworkConfig(connect=("tcp/127.0.0.1:1",), zenoh={"mode": "client", "connect/timeout_ms": 100}))
    assert "cannot connect to tcp/127.0.0.1:1" in str(raised.value)
    assert ".rs:" not in str(raised.value)
