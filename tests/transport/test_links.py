"""What is said on a link arrives whole and in order, or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.transport import Incoming, Outgoing, PoolReader, make_board, make_ring
from dataflow.transport.pool import SharedPool


class Pair:
    """Both ends of a link with two keys."""

    def __init__(self, most: tuple[int, int] | None = None, capacity: int = 4096) -> None:
        self.ring, self.board = make_ring(capacity), make_board()
        self.wakes = [os.eventfd(0, os.EFD_NONBLOCK) for _ in range(2)]
        self.producer = Outgoing(self.ring, self.wakes[0], self.board, most)
        self.lives = 0
        self.consumer = self.reader()

    def reader(self) -> Incoming:
        """The consumer, or the next process in its place."""
        self.lives += 1
        return Incoming(self.ring, self.wakes[1], self.board, ["a", "b"], PoolReader(), self.lives)

    def send(self, content: bytes, channel: int = 0, *, droppable: bool = True) -> None:
        self.producer.send(channel, [content], len(content), droppable=droppable, block=None)

    def taken(self) -> list[tuple[str, bytes]]:
        found = []
        for _ in range(1000):
            sent = self.producer.flush()
            got = [(key, bytes(payload)) for key, payload in self.consumer.take()]
            found += got
            if sent and not got:
                return found
        raise AssertionError("it does not come to an end")

    def close(self) -> None:
        for descriptor in (self.ring, self.board, *self.wakes):
            os.close(descriptor)


@pytest.fixture
def pair() -> Iterator[Pair]:
    made = Pair()
    yield made
    made.close()


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 9000)), max_size=30))
def test_messages_of_every_size_arrive_whole_and_in_order(sizes: list[tuple[int, int]]) -> None:
    pair = Pair()
    sent = [("ab"[channel], bytes([k]) * size) for k, (channel, size) in enumerate(sizes)]
    for key, content in sent:
        pair.send(content, "ab".index(key))
    assert pair.taken() == sent
    pair.close()


def test_the_oldest_messages_are_dropped_when_too_many_wait_and_ends_are_kept() -> None:
    pair = Pair(most=(5, 1 << 20))
    for k in range(30):
        pair.send(bytes([k]) * 900, droppable=k != 8)
    numbers = [payload[0] for _, payload in pair.taken()]
    assert numbers == sorted(numbers)
    assert 8 in numbers
    assert numbers[-1] == 29
    assert len(numbers) + pair.producer.dropped == 30
    pair.close()


def test_messages_for_a_dead_consumer_do_not_reach_its_successor(pair: Pair) -> None:
    for k in range(20):
        pair.send(bytes([k]) * 900)
    pair.producer.take_leave(1)
    pair.send(b"to nobody")
    pair.consumer = pair.reader()
    pair.send(b"to the successor")
    assert pair.taken() == [("a", b"to the successor")]


def test_a_late_death_notice_does_not_affect_the_successor(pair: Pair) -> None:
    pair.consumer = pair.reader()
    pair.send(b"to the successor")
    pair.producer.take_leave(1)
    pair.send(b"and this, too")
    assert pair.taken() == [("a", b"to the successor"), ("a", b"and this, too")]


def test_one_that_dies_unnoticed_after_another_is_gone_and_its_successor_is_served(pair: Pair) -> None:
    pair.reader()
    pair.producer.take_leave(1)
    pair.producer.take_leave(2)
    pair.send(b"to nobody")
    assert not pair.producer.present()
    pair.lives += 1  # the third dies before it listens
    pair.producer.take_leave(3)
    pair.consumer = pair.reader()
    pair.send(b"to the fourth")
    assert pair.taken() == [("a", b"to the fourth")]


def test_a_successor_takes_no_rest_of_a_message_that_began_before_it(pair: Pair) -> None:
    pair.send(bytes(8000))
    pair.consumer = pair.reader()
    pair.producer.flush()
    pair.send(b"next")
    assert pair.taken() == [("a", b"next")]


def test_half_a_message_of_a_producer_that_was_killed_is_forgotten(pair: Pair) -> None:
    pair.send(bytes(8000))
    list(pair.consumer.take())
    pair.producer = Outgoing(pair.ring, pair.wakes[0], pair.board, None)
    pair.send(b"next")
    pair.send(bytes(3000))
    assert pair.taken() == [("a", b"next"), ("a", bytes(3000))]


def test_a_block_is_free_when_its_consumer_dropped_released_or_died(pair: Pair) -> None:
    pool = SharedPool(1 << 20)
    held = [pool.write([bytes(70_000)], 70_000, (pair.producer.claim,)) for _ in range(2)]
    assert not any(block.free() for block in held if block)
    assert held[0] is not None
    assert held[1] is not None
    pair.producer.claim.drop(held[0])
    assert [block.free() for block in held if block] == [True, False]
    pair.producer.take_leave(1)
    assert held[1].free()
    pool.close()
