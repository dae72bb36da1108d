"""What scores keep of a long run: the same values as came, in little memory."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.messages import Detections2D
from operators.evaluation import object_log
from operators.evaluation.object_log import ObjectLog
from operators.evaluation.trajectory import PoseLog

COUNTS = st.lists(st.integers(0, 4), max_size=6)


def detections(stamp: int, count: int) -> Detections2D:
    rng = np.random.default_rng(stamp)
    corners = rng.uniform(0, 50, (count, 2)).astype(np.float32)
    return Detections2D(
        stamp=stamp,
        frame="camera",
        width=640 + stamp,
        height=480,
        class_names=("person", "chair", "table") if stamp % 2 else (),
        boxes=np.hstack([corners, corners + rng.uniform(1, 9, (count, 2)).astype(np.float32)]),
        scores=rng.random(count, np.float32),
        class_ids=rng.integers(0, 3, count).astype(np.int32),
    )


@given(COUNTS)
def test_objects_come_back_as_they_were(counts: list[int]) -> None:
    log, messages = ObjectLog(), [detections(stamp, count) for stamp, count in enumerate(counts)]
    ignored = [np.arange(m.count) % 2 == 1 for m in messages]
    for message, left_out in zip(messages, ignored, strict=True):
        log.add(message, left_out)

    assert log.stamps == [m.stamp for m in messages]
    for k, (message, left_out) in enumerate(zip(messages, ignored, strict=True)):
        found = log.image(k)
        assert found.size.tolist() == [message.width, message.height]
        assert np.array_equal(found.boxes, message.boxes.astype(np.float64))
        assert (found.boxes.dtype, found.boxes.shape) == (np.float64, (message.count, 4))
        assert found.labels == message.labels()
        assert np.array_equal(found.scores, message.scores)
        assert np.array_equal(found.ignored, left_out)


def test_objects_come_back_from_several_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_log, "_BLOCK", 3)
    test_objects_come_back_as_they_were()


def test_an_object_takes_25_bytes_and_nothing_is_moved_as_they_become_more() -> None:
    log = ObjectLog()
    for stamp in range(1000):
        log.add(detections(stamp, 20))
    blocks = log._objects._blocks
    assert sum(block.nbytes for block in blocks) < 20_000 * 25 * 1.1
    first = blocks[0]
    log.add(detections(1000, 5000))
    assert log._objects._blocks[0] is first


def test_poses_come_back_as_they_were() -> None:
    rng, log = np.random.default_rng(1), PoseLog()
    positions, orientations = rng.normal(size=(20, 3)), rng.normal(size=(20, 4))
    for k in range(20):
        log.append(k * 10**9, positions[k], orientations[k])

    found = log.trajectory()

    assert found.stamps == [k * 10**9 for k in range(20)]
    assert np.array_equal(found.positions, positions)
    assert np.array_equal(found.orientations, orientations)


def test_a_pose_takes_64_bytes() -> None:
    log = PoseLog()
    for k in range(10_000):
        log.append(k, np.zeros(3), np.zeros(4))
    taken = sum(sys.getsizeof(kept) for kept in vars(log).values())
    assert taken < 10_000 * 64 * 1.2
