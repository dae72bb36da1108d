"""MultiObjectTracker on boxes whose motion is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repeated import assert_repeats

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Detections2D, FeatureVector, Tracks, TrackState
from dataflow.testing import play
from operators.tracking import MultiObjectTracker
from operators.tracking.assignment import assign, overlap

FRAME = 100_000_000  # ns


def image(k: int, rows: Sequence[Sequence[float]], classes: Sequence[int] | None = None, **more: Any) -> Detections2D:
    """Detections of frame k: rows of (x1, y1, x2, y2, score)."""
    table = np.array(rows, np.float64).reshape(-1, 5)
    return Detections2D(
        stamp=(k + 1) * FRAME, **{"frame": "camera", "width": 640, "height": 480} | more,
        class_names=("person", "mug"), boxes=table[:, :4], scores=table[:, 4].astype(np.float32),
        class_ids=np.array(classes if classes is not None else [0] * len(table), np.int32),
    )  # fmt: skip


def walker(x: float, score: float = 0.9) -> list[float]:
    return [x, 100, x + 60, 260, score]


def tracked(images: Sequence[Detections2D], **params: Any) -> list[Tracks]:
    return play(MultiObjectTracker(**params), {"detections": images})["tracks"]


def ids(message: Tracks, *states: TrackState) -> list[int]:
    wanted = states or (TrackState.CONFIRMED,)
    return message.ids[np.isin(message.states, wanted)].tolist()


def test_a_steady_box_keeps_one_id_and_its_place() -> None:
    messages = tracked([image(k, [walker(100 + 8 * k)]) for k in range(12)])
    assert {i for m in messages for i in ids(m)} == {1}
    np.testing.assert_allclose(messages[-1].boxes[0], walker(100 + 8 * 11)[:4], atol=1.5)
    assert messages[-1].ages[0] == pytest.approx(1.1)


def test_an_id_outlasts_an_occlusion_and_a_crossing() -> None:
    """Two walk towards each other; one is hidden for half a second in the middle."""
    images = []
    for k in range(40):
        rows = [walker(20 + 10 * k)]
        if not 17 <= k <= 22:
            rows.append(walker(430 - 10 * k))
        images.append(image(k, rows))
    messages = tracked(images)
    assert ids(messages[-1]) == [1, 2]
    boxes = messages[-1].boxes
    assert boxes[0, 0] > boxes[1, 0] + 300
    assert ids(messages[19], TrackState.COASTING) == [2]


def test_weak_detections_continue_a_track_and_begin_none() -> None:
    weak = [image(k, [walker(100, 0.25), [400, 300, 440, 380, 0.25]]) for k in range(4, 12)]
    messages = tracked([image(k, [walker(100)]) for k in range(4)] + weak)
    assert all(ids(m) == [1] for m in messages)


def shifted(x: float, score: float) -> list[float]:
    """A walker's box that a detector gives a second time: IoU 0.5 to 0.6 with the first."""
    return [x + 14, 110, x + 78, 262, score]


def test_two_boxes_of_one_thing_that_enters_are_one_track_with_the_older_id() -> None:
    """The detector sees it twice at first; then the second box is weak, and lies beside the first one."""
    entering = [image(0, [walker(0, 0.6), shifted(0, 0.64)]), image(1, [walker(6, 0.58), shifted(6, 0.71)])]
    walking = [image(k, [walker(6 * k, 0.76), shifted(6 * k, 0.2)]) for k in range(2, 12)]
    messages = tracked([*entering, *walking])
    assert [ids(m, TrackState.CONFIRMED, TrackState.COASTING) for m in messages[5:]] == [[1]] * 7
    assert [i for m in messages for i in ids(m, TrackState.ENDED)] == [2]


@pytest.mark.parametrize("younger", [False, True])
def test_the_joined_track_has_the_older_id_whichever_of_the_two_goes_on(younger: bool) -> None:
    both = [image(k, [walker(100, 0.8), walker(118, 0.8)]) for k in range(2)]
    one = [image(k, [walker(118 if younger else 100, 0.8)]) for k in range(2, 8)]
    assert ids(tracked([*both, *one])[-1], TrackState.CONFIRMED, TrackState.COASTING) == [1]


def test_separate_tracks_continue_by_weak_boxes_when_they_meet() -> None:
    """Two enter together, one before the other, part, and meet again: the hidden one has weak boxes then."""
    images = [image(k, [walker(100), walker(118 + 12 * k)]) for k in range(5)]
    images += [image(k, [walker(100), walker(166 - 12 * (k - 4), 0.8 if k < 7 else 0.2)]) for k in range(5, 12)]
    assert ids(tracked(images)[-1]) == [1, 2]


def test_one_false_box_confirms_no_track() -> None:
    messages = tracked([image(0, [[10, 10, 80, 90, 0.6]]), *(image(k, []) for k in range(1, 6))])
    assert all(not ids(m, TrackState.CONFIRMED, TrackState.COASTING) for m in messages)
    assert ids(messages[-1], *TrackState) == []


def test_ended_track_is_listed_once_and_its_id_is_not_used_again() -> None:
    seen = [image(k, [walker(100)]) for k in range(4)]
    gone = [image(k, []) for k in range(4, 30)]
    messages = tracked([*seen, *gone, *(image(k, [walker(100)]) for k in range(30, 34))])
    assert [ids(m, TrackState.ENDED) for m in messages].count([1]) == 1
    assert ids(messages[-1]) == [2]


def test_tracks_name_the_detections_that_they_were_matched_with() -> None:
    empty, strays = [30.0, 40, 30, 90, 0.9], [400.0, 300, 440, 380, 0.25]
    rows = [[walker(100), walker(300)], [empty, walker(302), strays, walker(102)], [walker(104)]]
    messages = tracked([image(k, each) for k, each in enumerate(rows)])
    matched = [
        None if m.detections is None else dict(zip(m.ids.tolist(), m.detections.tolist(), strict=True))
        for m in messages
    ]
    assert matched == [{1: 0, 2: 1}, {1: 3, 2: 1}, {1: 0, 2: -1}]


def test_boxes_of_another_class_are_another_object() -> None:
    messages = tracked([image(k, [walker(100), walker(102)], [0, 1]) for k in range(5)])
    assert ids(messages[-1]) == [1, 2]
    assert messages[-1].labels() == ("person", "mug")


def test_appearance_keeps_apart_what_overlap_alone_confuses() -> None:
    """Two boxes change places between two images, as after a drop of frames."""
    red, blue = [1.0, 0.0], [0.0, 1.0]
    left, right = walker(100), walker(115)
    images, features = [], []
    for k in range(8):
        first, second = (left, right) if k < 5 else (right, left)
        images.append(image(k, [first, second]))
        vectors = np.array([red, blue], np.float32)
        features.append(FeatureVector(stamp=images[-1].stamp, model="colour", vectors=vectors))
    played = play(MultiObjectTracker(appearance=0.7), {"detections": images, "features": features})
    last = played["tracks"][-1]
    assert ids(last) == [1, 2]
    assert last.boxes[0, 0] > last.boxes[1, 0]
    looks = played["looks"][-1]
    assert (looks.model, looks.ids.tolist()) == ("colour", [1, 2])
    np.testing.assert_allclose(looks.vectors, [red, blue])


def test_tracks_carry_the_mean_direction_of_what_was_described_of_them() -> None:
    rows = ([[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 1], [0, 1]])
    images = [image(k, [walker(100), walker(200)]) for k in range(3)]
    features = [
        FeatureVector(stamp=each.stamp, model="m", vectors=np.array(row, np.float32))
        for each, row in zip(images, rows, strict=True)
    ]
    played = play(MultiObjectTracker(), {"detections": images, "features": features})
    first, second, third = played["looks"]
    assert first.ids.tolist() == [1], "rows of zeros were not described"
    np.testing.assert_allclose(second.vectors, [[1, 0], [0, 1]])
    np.testing.assert_allclose(third.vectors, [np.array([0.9, 0.1]) / np.hypot(0.9, 0.1), [0, 1]], rtol=1e-6)
    assert not play(MultiObjectTracker(), {"detections": images})["looks"]


def test_unusable_boxes_are_counted_and_survived() -> None:
    flat = [50, 10, 50, 60, 0.9]
    played = play(MultiObjectTracker(), {"detections": [image(k, [walker(100), flat]) for k in range(3)]})
    tracks, status = played["tracks"][-1], played["status"][-1]
    assert ids(tracks) == [1]
    assert status.pairs(0)["unusable boxes"] == "1"
    assert status.levels[0] == 1


def test_another_image_size_resets_the_tracks_and_another_camera_is_refused() -> None:
    changed = [image(k, [walker(100)], width=640 if k < 3 else 320) for k in range(6)]
    assert ids(tracked(changed)[-1]) == [2]
    with pytest.raises(OperatorFailure, match="detections are of camera rear, those before were of camera"):
        tracked([image(0, []), image(1, [], frame="rear")])


def test_trackers_repeat_and_a_restored_one_goes_on() -> None:
    rng = np.random.default_rng(3)
    images = [image(k, [walker(60 * j + 6 * k + rng.normal(), 0.8) for j in range(4)]) for k in range(20)]
    assert_repeats(MultiObjectTracker, [(each,) for each in images], 10)


@given(st.integers(0, 6), st.integers(0, 6), st.integers(0, 1000))
def test_assignment_takes_as_many_allowed_pairs_as_there_can_be(rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    value, allowed = rng.random((rows, columns)), rng.random((rows, columns)) < 0.5
    pairs = assign(value, allowed)
    assert all(allowed[p] for p in pairs)
    assert len({a for a, _ in pairs}) == len({b for _, b in pairs}) == len(pairs)
    free = np.array(sorted(set(range(rows)) - {a for a, _ in pairs}), int)
    left = np.array(sorted(set(range(columns)) - {b for _, b in pairs}), int)
    assert not allowed[np.ix_(free, left)].any()


def test_overlap_is_the_share_of_the_union() -> None:
    boxes = np.array([[0.0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 5, 5]])
    np.testing.assert_allclose(overlap(boxes[:1], boxes), [[1, 1 / 3, 0]])
