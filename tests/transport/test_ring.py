"""A ring gives every frame once and in order, wakes who waits, and survives the death of either end."""

from __future__ import annotations

import os
import select
import signal
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.transport.ring import RingError, RingReader, RingWriter, make_ring


class Ends:
    """A ring with both its ends and their eventfds."""

    def __init__(self, capacity: int = 4096) -> None:
        self.descriptor = make_ring(capacity)
        self.to_reader, self.to_writer = os.eventfd(0, os.EFD_NONBLOCK), os.eventfd(0, os.EFD_NONBLOCK)
        self.writer = RingWriter(self.descriptor, self.to_reader)
        self.reader = RingReader(self.descriptor, self.to_writer, 1)

    def close(self) -> None:
        self.writer.close()
        self.reader.close()
        for descriptor in (self.descriptor, self.to_reader, self.to_writer):
            os.close(descriptor)


@pytest.fixture
def ends() -> Iterator[Ends]:
    made = Ends()
    yield made
    made.close()


def woken(descriptor: int) -> bool:
    readable, _, _ = select.select([descriptor], [], [], 0)
    return bool(readable) and bool(os.eventfd_read(descriptor))


def test_frames_come_out_as_they_went_in(ends: Ends) -> None:
    assert ends.writer.put(3, [b"head", b"", b"body"])
    assert ends.writer.put(4, [])
    assert ends.reader.take(10) == [(3, b"headbody"), (4, b"")]
    assert ends.reader.take(10) == []


def test_a_full_ring_takes_nothing_until_there_is_room_and_then_wakes_its_writer(ends: Ends) -> None:
    frame = bytes(1000)
    while ends.writer.put(0, [frame]):
        pass
    assert not woken(ends.to_writer)
    assert ends.reader.take(1) == [(0, frame)]
    assert woken(ends.to_writer)
    assert ends.writer.put(0, [frame])


def test_a_reader_that_sleeps_is_woken_once(ends: Ends) -> None:
    assert ends.reader.sleep()
    ends.writer.put(0, [b"a"])
    ends.writer.put(0, [b"b"])
    assert woken(ends.to_reader)
    assert not woken(ends.to_reader)
    assert not ends.reader.sleep(), "there is something to take"
    assert len(ends.reader.take(10)) == 2


def test_a_reader_that_is_awake_is_not_woken(ends: Ends) -> None:
    ends.writer.put(0, [b"a"])
    assert not woken(ends.to_reader)


def test_a_frame_that_never_fits_is_refused(ends: Ends) -> None:
    assert ends.writer.largest == 1024 - 8
    with pytest.raises(RingError, match="2000 bytes does not fit a ring of 4096"):
        ends.writer.put(0, [bytes(2000)])


def test_a_ring_whose_reader_keeps_up_uses_little_of_its_memory() -> None:
    ends = Ends(1 << 20)
    for number in range(5000):
        content = number.to_bytes(4, "little") * (1 + number % 500)
        assert ends.writer.put(number % 3, [content])
        assert ends.reader.take(10) == [(number % 3, content)]
    assert os.fstat(ends.descriptor).st_blocks * 512 <= 100_000
    ends.close()


@given(st.lists(st.integers(1, (1 << 18) - 8), min_size=1, max_size=20))
def test_an_empty_ring_takes_every_frame_that_can_fit(sizes: list[int]) -> None:
    ends = Ends(1 << 20)
    for size in sizes:
        assert ends.writer.put(0, [bytes(size)])
        assert ends.reader.take(2) == [(0, bytes(size))]
    ends.close()


def test_writer_continues_after_a_killed_predecessor(ends: Ends) -> None:
    ends.writer.put(0, [b"before"])
    successor = RingWriter(ends.descriptor, ends.to_reader)
    successor.put(0, [b"after"])
    assert [content for _, content in ends.reader.take(10)] == [b"before", b"after"]
    successor.close()


def test_reader_skips_messages_for_its_predecessor(ends: Ends) -> None:
    ends.writer.put(0, [b"before"])
    successor = RingReader(ends.descriptor, ends.to_writer, 2)
    ends.writer.put(0, [b"after"])
    assert successor.take(10) == [(0, b"after")]
    successor.close()


def test_a_ring_that_was_written_over_is_refused(ends: Ends) -> None:
    ends.writer.put(0, [b"a"])
    os.pwrite(ends.descriptor, (10_000).to_bytes(4, "little"), 4096)
    with pytest.raises(RingError, match="beyond what was written"):
        ends.reader.take(1)


@given(st.lists(st.tuples(st.binary(max_size=900), st.integers(0, 3)), max_size=80))
def test_every_frame_comes_once_and_in_order_whenever_it_is_taken(steps: list[tuple[bytes, int]]) -> None:
    ends = Ends()
    try:
        accepted, taken = [], []
        for number, (content, takes) in enumerate(steps):
            if ends.writer.put(number, [content[:100], content[100:]]):
                accepted.append((number, content))
            taken += ends.reader.take(takes)
        taken += ends.reader.take(len(steps))
        assert taken == accepted
    finally:
        ends.close()


def test_between_processes_nothing_is_lost_and_a_kill_leaves_whole_frames(ends: Ends) -> None:
    pid = os.fork()
    if not pid:
        number = 0
        while True:
            frame = number.to_bytes(8, "little") * (1 + number % 100)
            while not ends.writer.put(number & 0xFFFF, [frame]):
                select.select([ends.to_writer], [], [], 1.0)
                os.eventfd_read(ends.to_writer)
            number += 1
    try:
        due = 0
        while due < 20_000:
            if ends.reader.sleep():
                assert select.select([ends.to_reader], [], [], 10.0)[0], "the writer has stopped"
                os.eventfd_read(ends.to_reader)
            for channel, frame in ends.reader.take(64):
                assert channel == due & 0xFFFF
                assert frame == due.to_bytes(8, "little") * (1 + due % 100)
                due += 1
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    left = ends.reader.take(1 << 20)
    assert [int.from_bytes(frame[:8], "little") for _, frame in left] == list(range(due, due + len(left)))
