"""Shared memory: read in place, never reused under a reader, given back by the dead, and nothing left behind."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from transport_envelopes import carrying

from dataflow.messages import DepthImage
from dataflow.transport import Bus, DecodeError, Envelope, Kind, decode
from dataflow.transport.envelope import MAGIC, PRELUDE, VERSION
from dataflow.transport.shared import SUPPORTED

pytestmark = pytest.mark.skipif(not SUPPORTED, reason=f"no memfd on {sys.platform}")

DEPTH = "robot1/camera/depth"
BLOCK = 384 << 10  # what a 256 x 256 float32 image takes


def depth_image(stamp: int, side: int = 256) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=np.full((side, side), stamp, np.float32))


def shared_files() -> set[str]:
    folder = Path("/dev/shm")
    return set(os.listdir(folder)) if folder.is_dir() else set()


def test_another_process_reads_in_place_and_held_messages_stay_intact(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    files = shared_files()
    bus = open_bus(listen=(endpoint,))
    publisher = bus.publisher(DEPTH, consumers=1)
    consumer = peer("consume", endpoint, "10")
    eventually(lambda: publisher.shares)
    eventually(lambda: bool(publisher.probe()) and bool(consumer.said()))
    for i in range(200):
        publisher.put(carrying(depth_image(i), DEPTH, i))
    publisher.put(Envelope(Kind.END, DEPTH, 0, 200, 199))
    ended = consumer.expect("ended")
    assert [s[1] for s in ended["seen"]] == list(range(201))
    assert (ended["damaged"], ended["kept"]) == (0, 20)
    assert bus.counters()["shared_messages"] == 200
    assert ended["counters"]["unresolved"] == 0
    assert consumer.leave() == 0
    assert shared_files() == files


@pytest.fixture
def shared_pair(
    open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> tuple[Bus, Any, deque[Any]]:
    """A publisher with a pool of four blocks, and the inbox of its one consumer."""
    first, second = open_bus(listen=(endpoint,), pool_bytes=4 * BLOCK), open_bus(connect=(endpoint,))
    inbox: deque[Any] = deque()
    second.subscribe(DEPTH, inbox.append)
    publisher = first.publisher(DEPTH, consumers=1)
    eventually(lambda: publisher.shares)
    return first, publisher, inbox


def send(publisher: Any, inbox: deque[Any], seq: int, eventually: Callable[..., None]) -> Any:
    publisher.put(carrying(depth_image(seq), DEPTH, seq))
    eventually(lambda: bool(inbox))
    message = decode(inbox.popleft()).message
    assert message is not None
    return message


def test_a_block_is_not_used_again_while_any_view_of_it_lives(
    shared_pair: tuple[Bus, Any, deque[Any]], eventually: Callable[..., None]
) -> None:
    bus, publisher, inbox = shared_pair
    held = send(publisher, inbox, 0, eventually).data[10:12, 3]  # a view of a view; the message itself is gone
    for seq in range(1, 30):
        assert send(publisher, inbox, seq, eventually) == depth_image(seq)
    assert held.tolist() == [0.0, 0.0]
    assert bus.counters()["shared_messages"] == 30
    assert bus.counters()["shared_full"] == 0


def test_without_room_messages_travel_whole_and_are_counted(
    shared_pair: tuple[Bus, Any, deque[Any]], eventually: Callable[..., None]
) -> None:
    bus, publisher, inbox = shared_pair
    held = [send(publisher, inbox, seq, eventually) for seq in range(7)]
    assert [m == depth_image(i) for i, m in enumerate(held)] == [True] * 7
    assert (bus.counters()["shared_messages"], bus.counters()["shared_full"]) == (4, 3)
    held.clear()
    assert send(publisher, inbox, 7, eventually) == depth_image(7)
    assert bus.counters()["shared_messages"] == 5


def test_a_pool_that_nobody_holds_is_cut_anew_for_another_size(
    shared_pair: tuple[Bus, Any, deque[Any]], eventually: Callable[..., None]
) -> None:
    bus, publisher, inbox = shared_pair
    held = [send(publisher, inbox, seq, eventually) for seq in range(4)]
    held.clear()
    publisher.put(carrying(depth_image(9, 512), DEPTH, 4))  # 1 MB: fits only where all four were
    eventually(lambda: bool(inbox))
    assert decode(inbox.popleft()).message == depth_image(9, 512)
    assert bus.counters()["shared_full"] == 0


def test_small_messages_and_frontiers_travel_whole_in_the_same_order(
    shared_pair: tuple[Bus, Any, deque[Any]], eventually: Callable[..., None]
) -> None:
    bus, publisher, inbox = shared_pair
    for seq in range(30):
        publisher.put(carrying(depth_image(2 * seq, 256 if seq % 3 == 0 else 4), DEPTH, seq))
        publisher.put(Envelope(Kind.FRONTIER, DEPTH, 0, seq + 1, 2 * seq + 1))
    eventually(lambda: len(inbox) == 60)
    assert [decode(p).stamp for p in inbox] == list(range(60))
    assert 0 < bus.counters()["shared_messages"] <= 10


def test_nothing_is_shared_while_a_consumer_is_not_known_to_share(
    open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    first = open_bus(listen=(endpoint,))
    inboxes: list[deque[Any]] = [deque(), deque()]
    publisher = first.publisher(DEPTH, consumers=2)
    for inbox, shares in zip(inboxes, (True, False), strict=True):
        open_bus(connect=(endpoint,), shared_memory=shares).subscribe(DEPTH, inbox.append)

    def arrives() -> bool:
        publisher.put(carrying(depth_image(1), DEPTH, 0))
        return all(inboxes)

    eventually(arrives)
    assert all(decode(p).message == depth_image(1) for inbox in inboxes for p in list(inbox))
    assert first.counters()["shared_messages"] == 0
    assert first.counters()["shared_unready"] > 0


def hold_the_whole_pool(publisher: Any, consumer: Any, eventually: Callable[..., None]) -> None:
    """Sends as many messages as the pool has blocks to a consumer that keeps them, and kills it."""
    eventually(lambda: publisher.shares)
    eventually(lambda: bool(publisher.probe()) and bool(consumer.said()))
    for seq in range(3):
        publisher.put(carrying(depth_image(seq), DEPTH, seq))
        assert consumer.expect("holding")["count"] == seq + 1
    consumer.kill()
    eventually(lambda: not publisher.shares)


def test_blocks_of_a_killed_consumer_are_given_back(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    bus = open_bus(listen=(endpoint,), pool_bytes=3 * BLOCK)
    publisher = bus.publisher(DEPTH, consumers=1)
    for total in (3, 6):
        hold_the_whole_pool(publisher, peer("hold", endpoint), eventually)
        assert bus.counters()["shared_messages"] == total
    assert bus.counters()["shared_full"] == 0


def test_messages_of_a_killed_publisher_stay_readable_and_it_leaves_nothing(
    peer: Callable[..., Any], open_bus: Callable[..., Bus], endpoint: str, eventually: Callable[..., None]
) -> None:
    files = shared_files()
    producer = peer("produce", endpoint, "5")
    producer.expect("up")
    bus = open_bus(connect=(endpoint,))
    inbox: deque[Any] = deque()
    bus.subscribe(DEPTH, inbox.append)
    producer.tell()
    assert producer.expect("sent")["counters"]["shared_messages"] == 5

    def messages() -> list[Any]:
        return [e.message for e in map(decode, list(inbox)) if e.message is not None]

    eventually(lambda: len(messages()) == 5)
    producer.kill()
    assert messages() == [depth_image(i) for i in range(5)]
    assert shared_files() == files


@pytest.mark.parametrize(
    "body",
    [
        msgpack.packb(("0" * 16, 1, os.getpid(), 0, 0, 100, 0, 1)),
        msgpack.packb(("0" * 16, 1, 2**40, 5, 0, 100, 0, 1)),
        msgpack.packb(("x", 1)),
        b"\xc1",
    ],
)
def test_a_reference_to_anything_else_is_refused(
    shared_pair: tuple[Bus, Any, deque[Any]], eventually: Callable[..., None], body: bytes
) -> None:
    _, publisher, inbox = shared_pair
    head = msgpack.packb((DEPTH, 0, 3, 7, 0, ""))
    publisher.put_bytes(PRELUDE.pack(MAGIC, VERSION, Kind.REFERENCE, len(head), len(body)) + head + body)
    eventually(lambda: bool(inbox))
    with pytest.raises(DecodeError, match="could not be opened"):
        decode(inbox.popleft())
