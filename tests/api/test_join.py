"""Streams joined by timestamp, against a search through all pairs and pandas' own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from analysed import imu
from hypothesis import given
from hypothesis import strategies as st

import dataflow
from dataflow.api.asof import NONE, Direction, asof

if TYPE_CHECKING:  # imported before the first of these tests runs (tests/conftest.py)
    import pandas as pd

stamps = st.lists(st.integers(-20, 20), max_size=12)


def by_search(anchor: int, other: list[int], direction: Direction, tolerance: int | None) -> set[int]:
    """The stamps that may match: one, or none."""
    able = [s for s in other if tolerance is None or abs(s - anchor) <= tolerance]
    if direction == "backward":
        return {max(s for s in able if s <= anchor)} if any(s <= anchor for s in able) else set()
    if direction == "forward":
        return {min(s for s in able if s >= anchor)} if any(s >= anchor for s in able) else set()
    return {min(able, key=lambda s: (abs(s - anchor), s))} if able else set()


@given(stamps, stamps, st.sampled_from(["backward", "forward", "nearest"]), st.none() | st.integers(0, 9))
def test_every_match_is_the_one_that_a_search_finds(
    anchors: list[int], others: list[int], direction: Direction, tolerance: int | None
) -> None:
    places = asof(np.array(anchors, np.int64), np.array(others, np.int64), direction, tolerance)

    for anchor, place in zip(anchors, places.tolist(), strict=True):
        wanted = by_search(anchor, others, direction, tolerance)
        assert ({others[place]} if place != NONE else set()) == wanted


def test_an_unknown_direction_is_refused() -> None:
    with pytest.raises(ValueError, match="expected backward, forward, nearest"):
        asof(np.zeros(1, np.int64), np.zeros(1, np.int64), "sideways")


def test_rows_hold_the_messages_and_none_where_there_is_no_match(recording: dataflow.RecordedStreams) -> None:
    joined = recording.join("imu", "image", tolerance=0.005)

    assert len(joined) == 11
    assert joined[0] == (imu(0), None)
    assert joined[5] == (imu(5), None)  # the image at 43 ms is 7 ms old
    whole = recording.join("imu", "image").complete()
    assert [row[1] for row in whole][:2] == [recording["image"][0]] * 2
    assert len(whole) == 10
    assert recording.join("image", "imu", direction="nearest").offsets()["r1/robot/imu"] == pytest.approx([-0.003] * 3)


def test_a_table_of_matches_agrees_with_pandas(recording: dataflow.RecordedStreams) -> None:
    frame = recording.join("objects", "imu", "image").frame()
    objects, samples = recording["objects"].frame(), recording["imu"].frame()

    expected = pd.merge_asof(objects[["stamp"]], samples[["stamp", "angular_velocity.x"]], on="stamp")
    assert frame["imu.angular_velocity.x"].tolist() == expected["angular_velocity.x"].tolist()
    assert frame["image.stamp"].iloc[0] is None
    assert frame["objects.stamp"].tolist() == objects["stamp"].tolist()


def test_a_join_with_an_empty_stream_has_no_matches(recording: dataflow.RecordedStreams) -> None:
    joined = recording.join("imu", "battery")

    assert [row[1] for row in joined] == [None] * 11
    assert np.isnan(joined.offsets()["r1/robot/battery"]).all()
    assert len(joined.complete()) == 0
    assert joined.frame()["imu.angular_velocity.x"].notna().all()
