"""The pool of shared memory: who holds what, what comes free for whom, and what is mapped."""

from __future__ import annotations

import itertools
import os
import sys
import threading
import time
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from transport_envelopes import Holder, carrying

from dataflow.messages import DepthImage
from dataflow.transport.codec import encode_head, encode_parts, parts_size
from dataflow.transport.pool import Block, SharedPool
from dataflow.transport.publisher import Counters
from dataflow.transport.shared import Board, PoolReader, make_board

KIB = 1 << 10
DEPTH = "robot1/camera/depth"


def write(pool: SharedPool, size: int, holder: Holder) -> Block | None:
    return pool.write([b"x" * size], size, (holder,))


def test_released_blocks_are_reused_for_another_size() -> None:
    pool, holder = SharedPool(1024 * KIB), Holder()
    small = [write(pool, 64 * KIB, holder) for _ in range(16)]
    assert write(pool, 512 * KIB, holder) is None
    for block in small[:8]:
        assert block is not None
        holder.release(block)
    large = write(pool, 512 * KIB, holder)
    assert large is not None
    assert large.offset == 0
    holder.release(large)
    assert [write(pool, 64 * KIB, holder) is not None for _ in range(9)] == [True] * 8 + [False]
    pool.close()


STEPS = st.lists(st.tuples(st.booleans(), st.integers(1, 700), st.integers(0, 30)), max_size=60)


@settings(max_examples=60, deadline=None)
@given(STEPS)
def test_blocks_never_overlap_and_an_unheld_pool_serves_every_size(steps: list[tuple[bool, int, int]]) -> None:
    pool, holder = SharedPool(1024 * KIB), Holder()
    held: list[Block] = []
    for release, size, which in steps:
        if release and held:
            holder.release(held.pop(which % len(held)))
            continue
        block = write(pool, size * KIB, holder)
        if block is not None:
            held.append(block)
        spans = sorted((b.offset, b.offset + b.capacity) for b in held)
        assert all(end <= start for (_, end), (start, _) in itertools.pairwise(spans))
        assert not spans or spans[-1][1] <= pool.size
        assert len({b.slot for b in held}) == len(held)
    for block in held:
        holder.release(block)
    assert write(pool, 1024 * KIB, holder) is not None
    pool.close()


def mappings() -> int:
    """How many pools this process has mapped read-only, as the kernel says."""
    return sum(
        "dataflow-pool-" in line and line.split()[1].startswith("r--")
        for line in Path("/proc/self/maps").read_text().splitlines()
    )


def references(pool: SharedPool, count: int) -> list[bytes]:
    """Messages that a publisher with this pool sends to a consumer that releases nothing."""
    sent = []
    for seq in range(count):
        image = DepthImage(stamp=seq, frame="camera", data=np.full((128, 128), seq, np.float32))
        envelope = carrying(image, DEPTH, seq)
        parts = encode_parts(envelope)
        block = pool.write(parts, parts_size(parts), (Holder(),))
        assert block is not None
        sent.append(pool.reference(encode_head(envelope), block, parts_size(parts)))
    return sent


def test_the_pool_of_a_publisher_that_was_replaced_is_unmapped_with_its_last_view() -> None:
    before = mappings()
    descriptor = make_board()
    board, reader = Board(descriptor), PoolReader()
    views: list[memoryview] = []
    for _ in range(5):
        pool = SharedPool(1024 * KIB)
        views = [reader.resolve(reference, board) for reference in references(pool, 3)]
        pool.close()
    assert mappings() == before + 1
    old = views
    pool = SharedPool(1024 * KIB)
    new = [reader.resolve(reference, board) for reference in references(pool, 1)]
    pool.close()
    assert mappings() == before + 2
    assert bytes(old[2][-4:]) == np.float32(2).tobytes()
    old.clear()
    views.clear()
    assert mappings() == before + 1
    new.clear()
    del board
    os.close(descriptor)
    assert mappings() == before


class GivesWay(int):
    """A number that lets another thread go on while something is added to it."""

    def __add__(self, other: int) -> GivesWay:
        now = int(self)
        time.sleep(0)
        return GivesWay(now + other)


def test_counts_of_several_threads_are_complete() -> None:
    counters = Counters()
    counters._counts = dict.fromkeys(counters.as_dict(), GivesWay(0))
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [
            threading.Thread(target=lambda: [counters.published(3) for _ in range(5000)] and None) for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert counters.as_dict()["published_messages"] == 20_000
    assert counters.as_dict()["published_bytes"] == 60_000
