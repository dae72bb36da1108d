"""What a process did is known after it was killed, at whatever instruction."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.records import black_box as module
from dataflow.records.black_box import BlackBox, OperatorProgress, make_black_box, read_black_box
from dataflow.records.firing import Emission, FiringRecord, decode_batch

PORTS = {"camera": ("image", "info"), "detector": ("boxes",)}


def record(index: int, operator: str = "camera", *, size: int = 0, kind: str = "fire") -> FiringRecord:
    outputs = (Emission(index, 100 + index, bytes(16)), *(None for _ in PORTS[operator][1:]))
    detail = {"name": "gain", "value": index} if kind == "param" else {"state": bytes(size)}
    return FiringRecord(operator, 0, index, kind, 100 + index, outputs=outputs, detail=detail)


@pytest.fixture
def memory() -> Iterator[int]:
    descriptor = make_black_box()
    yield descriptor
    os.close(descriptor)


def kept(memory: int, operator: str) -> list[int]:
    return [decode_batch(data).records[0].index for data in read_black_box(memory, PORTS).batches[operator]]


def test_a_new_black_box_is_empty(memory: int) -> None:
    assert read_black_box(memory, PORTS).reached == {"camera": OperatorProgress(), "detector": OperatorProgress()}


def test_black_box_records_are_read_back_by_operator(memory: int) -> None:
    box = BlackBox(memory, PORTS)
    for index in range(5):
        box.add(record(index))
        box.add(record(index, "detector"))
    assert kept(memory, "camera") == kept(memory, "detector") == [0, 1, 2, 3, 4]
    assert read_black_box(memory, PORTS).reached["camera"].last == {"image": 104}


def test_the_latest_records_are_kept_and_older_ones_leave_where_they_led(memory: int) -> None:
    box = BlackBox(memory, PORTS)
    box.add(record(0, "detector"))
    box.add(record(1, "detector", kind="param"))
    for index in range(40):
        box.add(record(index, size=module.SEGMENT // 8))
    indices = kept(memory, "camera")
    assert indices[-1] == 39
    assert len(indices) >= 7
    assert all(b == a + 1 for a, b in pairwise(indices))
    remains = read_black_box(memory, PORTS)
    assert not remains.batches["detector"]
    assert remains.reached["detector"] == OperatorProgress(0, {"boxes": 101}, {"gain": 1}, {"boxes": (0, 2)})
    assert remains.reached["camera"].last == {"image": 139}


def test_a_record_larger_than_a_segment_is_kept_and_its_memory_given_back(memory: int) -> None:
    box = BlackBox(memory, PORTS)
    for index in range(6):
        box.add(record(index, size=3 * module.SEGMENT))
    assert kept(memory, "camera")[-2:] == [4, 5]
    held = os.fstat(memory).st_blocks * 512
    assert held < 5 * 3 * module.SEGMENT  # two segments of two records each; six were written


def test_records_that_grow_take_no_more_memory_than_the_latest_ones(memory: int) -> None:
    """As snapshots of a map that grows do: what a segment took before it was enlarged is given back."""
    sizes = [module.SEGMENT * 2**k for k in range(7)]
    box = BlackBox(memory, PORTS)
    for index, size in enumerate(sizes):
        box.add(record(index, size=size))
    assert kept(memory, "camera")[-1] == 6
    assert os.fstat(memory).st_blocks * 512 < 1.1 * sum(sizes[-2:])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 3000), min_size=1, max_size=60))
def test_black_box_keeps_the_latest_records_without_gaps(sizes: list[int]) -> None:
    memory = make_black_box()
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "SEGMENT", 4096)
            os.ftruncate(memory, 4096 * 3)
            for segment in range(2):
                os.pwrite(memory, module.struct.pack("<4Q", 0, 4096 * (1 + segment), 4096, 0), 32 * segment)
            box = BlackBox(memory, PORTS)
            for index, size in enumerate(sizes):
                box.add(record(index, size=size))
        indices = kept(memory, "camera")
        assert indices == list(range(indices[0], len(sizes)))
        assert read_black_box(memory, PORTS).reached["camera"].last == {"image": 99 + len(sizes)}
    finally:
        os.close(memory)


def test_a_killed_process_leaves_whole_records_up_to_its_last(memory: int) -> None:
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        box = BlackBox(memory, PORTS)
        index = 0
        while True:
            box.add(record(index, size=index % 5000))
            os.write(writing, b".")
            index += 1
    try:
        written = 0
        while written < 3000:
            written += len(os.read(reading, 4096))
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(writing)
    while data := os.read(reading, 65536):
        written += len(data)
    os.close(reading)
    indices = kept(memory, "camera")
    assert indices == list(range(indices[0], indices[-1] + 1))
    assert written - 1 <= indices[-1] <= written
