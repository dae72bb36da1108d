"""Large arrays of messages that are made in the pool: sent from there, and left alone while anybody holds them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from transport_envelopes import Holder, carrying

from dataflow.messages import DepthImage, Message, PointCloud
from dataflow.messages.fields.memory import LARGE, copied, make_large_arrays_in
from dataflow.transport.codec import decode, encode_parts, parts_size
from dataflow.transport.pool import Block, SharedPool

KIB = 1 << 10


@pytest.fixture
def pool() -> Iterator[SharedPool]:
    pool = SharedPool(8 << 20)
    make_large_arrays_in(pool.room)
    yield pool
    make_large_arrays_in(None)
    pool.close()


def depth(number: int, rows: int = 128) -> DepthImage:
    return DepthImage(stamp=number, frame="camera", data=np.full((rows, 128), number, np.float32))


@dataclass
class Sent:
    block: Block
    size: int

    def decoded(self, pool: SharedPool) -> Message | None:
        """The message as a consumer sees it at this moment."""
        return decode(bytes(pool._view[self.block.start : self.block.start + self.size])).message

    def holds(self, pool: SharedPool, array: npt.NDArray[Any]) -> bool:
        """Whether an array lies in the block."""
        piece = np.frombuffer(pool._view, np.uint8, self.block.capacity, self.block.offset)
        return np.shares_memory(array, piece)


def send(pool: SharedPool, message: Message, holder: Holder, stream: str = "robot1/camera/depth") -> Sent | None:
    parts = encode_parts(carrying(message, stream, message.stamp))
    block = pool.write(parts, parts_size(parts), (holder,))
    return None if block is None else Sent(block, parts_size(parts))


def test_a_message_is_sent_from_where_its_array_was_made(pool: SharedPool) -> None:
    message = depth(7)
    sent = send(pool, message, Holder())
    assert sent is not None
    assert sent.holds(pool, message.data)
    assert sent.block.start % 64 == 0
    assert sent.decoded(pool) == message


def test_message_sent_on_another_stream_is_copied(pool: SharedPool) -> None:
    message, holder = depth(7), Holder()
    first, second = send(pool, message, holder, "a/b"), send(pool, message, holder, "a/another")
    assert first is not None
    assert second is not None
    assert (first.holds(pool, message.data), second.holds(pool, message.data)) == (True, False)
    streams = [decode(bytes(pool._view[s.block.start : s.block.start + s.size])).stream for s in (first, second)]
    assert streams == ["a/b", "a/another"]


def test_a_message_of_several_large_arrays_is_sent_whole(pool: SharedPool) -> None:
    rng = np.random.default_rng(1)
    cloud = PointCloud(
        stamp=1,
        frame="lidar",
        points=rng.random((20_000, 3), np.float32),
        colors=rng.integers(0, 255, (20_000, 3)).astype(np.uint8),
    )
    sent = send(pool, cloud, Holder())
    assert sent is not None
    assert sent.decoded(pool) == cloud


def test_an_array_is_its_own_process_s_until_the_last_view_of_it_is_gone(pool: SharedPool) -> None:
    message, holder = depth(7), Holder()
    row = message.data[3]
    sent = send(pool, message, holder)
    assert sent is not None
    del message
    assert not sent.block.free()
    holder.done.add(sent.block.generation)
    assert not sent.block.free()
    assert row.tolist() == [7] * 128
    del row
    assert sent.block.free()


def test_arrays_that_a_process_keeps_leave_most_of_the_pool_to_others(pool: SharedPool) -> None:
    kept = [depth(k) for k in range(200)]
    assert pool.free() >= pool.size * 3 // 4
    assert len(pool._arrays) > 10
    kept.clear()
    assert pool.free() == pool.size
    again = depth(1)
    assert len(pool._arrays) == 1
    assert again.data.any()


def test_an_array_is_made_elsewhere_rather_than_waited_for(pool: SharedPool) -> None:
    """Another thread may be at the pool; or this one is, and a finaliser makes a message."""
    with pool._lock:
        assert pool.room(LARGE) is None
        message = depth(5)
    assert (message.data == 5).all()
    assert not pool._arrays
    assert depth(6).data.base is not None
    assert pool.room(LARGE) is not None


def test_arrays_outlive_the_pool_and_new_ones_are_made_elsewhere() -> None:
    pool = SharedPool(1 << 20)
    make_large_arrays_in(pool.room)
    try:
        message = depth(3)
        pool.close()
        assert (message.data == 3).all()
        assert pool.room(LARGE) is None
        assert (depth(4).data == 4).all()
    finally:
        make_large_arrays_in(None)


def test_forked_child_allocates_arrays_outside_the_pool(pool: SharedPool) -> None:
    """It would write where its parent does."""
    child = os.fork()
    if child == 0:
        made = depth(1)
        os._exit(0 if not pool._arrays and (made.data == 1).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("wanted", [np.s_[:], np.s_[::2], np.s_[:, ::3], np.s_[:, 5:90]])
def test_a_copy_is_contiguous_and_the_same_bit_for_bit(pool: SharedPool, wanted: Any) -> None:
    bits = np.random.default_rng(2).integers(0, 2**32, (400, 300), np.uint32)  # NaNs of all kinds among them
    array = bits.view(np.float32)[wanted]
    made = copied(array)
    assert made.flags.c_contiguous
    assert made.view(np.uint32).tolist() == bits[wanted].tolist()


STEPS = st.lists(st.tuples(st.sampled_from(["make", "send", "drop", "release"]), st.integers(0, 40)), max_size=60)


@settings(max_examples=60, deadline=None)
@given(STEPS)
def test_held_blocks_are_never_overwritten(steps: list[tuple[str, int]]) -> None:
    pool, holder = SharedPool(4 << 20), Holder()
    make_large_arrays_in(pool.room)
    held: list[DepthImage] = []
    under_way: list[tuple[int, Sent]] = []
    try:
        for number, (step, which) in enumerate(steps):
            if step == "make":
                held.append(depth(number, rows=80 + 40 * which))
            elif step == "send" and held:
                sent = send(pool, held[which % len(held)], holder)
                if sent is not None:
                    under_way.append((held[which % len(held)].stamp, sent))
            elif step == "drop" and held:
                held.pop(which % len(held))
            elif step == "release" and under_way:
                holder.done.add(under_way.pop(which % len(under_way))[1].block.generation)
            assert all((message.data == message.stamp).all() for message in held)
            for stamp, sent in under_way:
                seen = sent.decoded(pool)
                assert isinstance(seen, DepthImage)
                assert (seen.data == stamp).all()
        held.clear()
        holder.done.update(sent.block.generation for _, sent in under_way)
        assert pool.free() == pool.size
    finally:
        make_large_arrays_in(None)
        pool.close()
