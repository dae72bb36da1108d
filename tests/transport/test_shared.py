"""Shared memory: read in place, never reused under a reader, given back by the dead, and nothing left behind."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from transport_envelopes import carrying, depth_image

from dataflow.messages import DepthImage
from dataflow.messages.base import Message
from dataflow.transport import (
    DecodeError,
    Fanout,
    Incoming,
    Kind,
    Outgoing,
    PoolReader,
    decode,
    encode_parts,
    make_board,
    make_ring,
)
from dataflow.transport.envelope import MAGIC, PRELUDE, VERSION

DEPTH = "robot1/camera/depth"
BLOCK = 384 << 10  # what a 256 x 256 float32 image takes


def shared_files() -> set[str]:
    """Files in shared memory that could hold a block; other programs' semaphores come and go meanwhile."""
    folder = Path("/dev/shm")
    if not folder.is_dir():
        return set()
    return {f.name for f in folder.iterdir() if f.is_file() and not f.name.startswith("sem.")}


class Shared:
    """A producer with a pool of so many blocks, and the consumers of its stream."""

    def __init__(self, consumers: int = 1, blocks: int = 4, most: tuple[int, int] | None = None) -> None:
        self.descriptors = [(make_ring(), os.eventfd(0, os.EFD_NONBLOCK), make_board()) for _ in range(consumers)]
        self.outgoing = [Outgoing(*d, most) for d in self.descriptors]
        self.fanout = Fanout([([DEPTH], link) for link in self.outgoing], pool_bytes=blocks * BLOCK)
        self.consumers = [self.consumer(k) for k in range(consumers)]

    def consumer(self, number: int = 0, life: int = 1) -> Incoming:
        return Incoming(*self.descriptors[number], [DEPTH], PoolReader(), life)

    def send(self, seq: int, side: int = 256) -> None:
        envelope = carrying(depth_image(seq, side), DEPTH, seq)
        self.fanout.send(DEPTH, encode_parts(envelope), envelope=envelope)

    def taken(self, number: int = 0) -> list[Message]:
        messages = [decode(payload).message for _, payload in self.consumers[number].take()]
        return [message for message in messages if message is not None]

    def passed(self, seq: int, side: int = 256) -> Message:
        self.send(seq, side)
        (message,) = self.taken()
        return message

    def close(self) -> None:
        for consumer in self.consumers:
            list(consumer.take())
        self.fanout.close()
        for descriptor in (each for three in self.descriptors for each in three):
            os.close(descriptor)


@pytest.fixture
def shared() -> Iterator[Shared]:
    made = Shared()
    yield made
    made.close()


def test_a_block_is_not_used_again_while_any_view_of_it_lives(shared: Shared) -> None:
    message = shared.passed(0)
    assert isinstance(message, DepthImage)
    held = message.data[10:12, 3]  # a view of a view; the message itself is gone
    del message
    for seq in range(1, 30):
        assert shared.passed(seq) == depth_image(seq, 256)
    assert held.tolist() == [0.0, 0.0]
    assert shared.fanout.counters()["shared_messages"] == 30
    assert shared.fanout.counters()["shared_full"] == 0


def test_without_room_messages_travel_whole_and_are_counted(shared: Shared) -> None:
    held = []
    for seq in range(7):
        shared.send(seq)
        while not (taken := shared.taken()):
            shared.fanout.flush()
        held += taken
    assert held == [depth_image(i, 256) for i in range(7)]
    counts = shared.fanout.counters()
    assert (counts["shared_messages"], counts["shared_full"]) == (4, 3)
    held.clear()
    taken.clear()
    assert shared.passed(7) == depth_image(7, 256)
    assert shared.fanout.counters()["shared_messages"] == 5


def test_unheld_pool_is_resized_for_other_messages(shared: Shared) -> None:
    held = [shared.passed(seq) for seq in range(4)]
    held.clear()
    assert shared.passed(9, 512) == depth_image(9, 512)  # 1 MB: fits only where all four were
    assert shared.fanout.counters()["shared_full"] == 0


def test_small_messages_travel_whole_in_the_same_order(shared: Shared) -> None:
    for seq in range(30):
        shared.send(seq, 256 if seq % 10 == 0 else 4)
    assert [m.stamp for m in shared.taken()] == list(range(30))
    assert shared.fanout.counters()["shared_messages"] == 3


def test_a_consumer_that_takes_nothing_leaves_room_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a live run it may hold as much of the pool as it leaves free."""
    monkeypatch.setattr("dataflow.transport.links.STILL", 0.0)
    shared = Shared(consumers=2, blocks=8, most=(1000, 1 << 30))
    for seq in range(50):
        shared.send(seq)
        assert shared.taken(0) == [depth_image(seq, 256)]
    counts = shared.fanout.counters()
    assert (counts["shared_messages"], counts["shared_full"]) == (50, 0)
    held = [m.stamp for m in shared.taken(1)]
    assert held == list(range(len(held)))
    assert 4 <= len(held) <= 5
    assert [link.dropped for link in shared.outgoing] == [0, 50 - len(held)]
    shared.close()


def test_where_nothing_may_be_lost_all_of_the_pool_may_be_held() -> None:
    shared = Shared(consumers=2, blocks=8)
    for seq in range(8):
        shared.send(seq)
    assert shared.fanout.counters()["shared_full"] == 0
    assert [m.stamp for m in shared.taken(1)] == list(range(8))
    shared.close()


def test_memory_held_by_a_replaced_consumer_is_freed(shared: Shared) -> None:
    held = [shared.passed(seq) for seq in range(4)]
    shared.outgoing[0].take_leave(1)
    shared.consumers[0] = shared.consumer(life=2)
    assert [shared.passed(seq) == depth_image(seq, 256) for seq in range(4, 8)] == [True] * 4
    assert shared.fanout.counters()["shared_full"] == 0
    held.clear()


def test_messages_of_a_killed_producer_stay_readable_and_it_leaves_nothing() -> None:
    files = shared_files()
    shared = Shared()
    pid = os.fork()
    if not pid:
        for seq in range(4):
            shared.send(seq)
        signal.pause()
    messages: list[Message] = []
    while len(messages) < 4:
        messages += shared.taken()
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    assert messages == [depth_image(i, 256) for i in range(4)]
    assert shared_files() == files
    shared.close()


@pytest.mark.parametrize(
    "body",
    [
        msgpack.packb(("0" * 16, 1, os.getpid(), 0, 0, 100, 0, 1)),
        msgpack.packb(("0" * 16, 1, 2**40, 5, 0, 100, 0, 1)),
        msgpack.packb(("x", 1)),
        b"\xc1",
    ],
    ids=["no shared memory", "a number too large", "too few fields", "no msgpack"],
)
def test_a_reference_to_anything_else_is_refused(shared: Shared, body: bytes) -> None:
    head = msgpack.packb((DEPTH, 0, 3, 7, 0, ""))
    reference = PRELUDE.pack(MAGIC, VERSION, Kind.REFERENCE, len(head), len(body)) + head + body
    shared.fanout.send(DEPTH, [reference])
    ((_, payload),) = shared.consumers[0].take()
    with pytest.raises(DecodeError, match="could not be opened"):
        decode(payload)
    assert shared.consumers[0].unresolved == 1
