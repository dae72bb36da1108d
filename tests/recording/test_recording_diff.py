"""diff finds what differs, says where first, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_recordings import foreign, pose

from dataflow.messages import DepthImage, Image, LaserScan, Message, WheelTicks
from dataflow.recording import DiffReport, Recording, RecordingError
from dataflow.recording.streams.diff import diff


def compare(a: Path, b: Path, **options: Any) -> DiffReport:
    with Recording(a) as left, Recording(b) as right:
        return diff(left, right, **options)


def test_a_recording_is_the_same_as_itself_and_as_a_differently_written_one(record: Callable[..., Path]) -> None:
    rows = [(n, pose(i)) for i in range(10) for n in "ab"]
    a = record(rows, name="a.mcap")
    b = record(sorted(rows, key=lambda r: r[0]), name="b.mcap", compression="none", chunk_bytes=1)
    report = compare(a, b)
    assert report.same
    assert [(s.stream, s.outcome, s.count_a) for s in report.streams] == [("a", "same", 10), ("b", "same", 10)]


def test_logs_are_no_results_and_are_compared_when_they_are_named(record: Callable[..., Path]) -> None:
    logs = ("@/logs", "test/@/logs")
    a = record([("s", pose(0)), *((name, pose(1)) for name in logs)], name="a.mcap")
    b = record([("s", pose(0)), *((name, pose(2)) for name in logs)], name="b.mcap")

    assert [s.stream for s in compare(a, b).streams] == ["s"]
    assert compare(a, b).same
    assert not compare(a, b, streams=["test/@/logs"]).same


def test_the_first_difference_has_stamp_and_field(record: Callable[..., Path]) -> None:
    a = record([("s", pose(i)) for i in range(5)], name="a.mcap")
    b = record([("s", pose(i, x=0.5 if i >= 3 else 0.0)) for i in range(5)], name="b.mcap")
    [stream] = compare(a, b).streams
    assert (stream.outcome, stream.differing, stream.max_difference) == ("different", 2, 0.5)
    assert stream.first is not None
    assert (stream.first.stamp, stream.first.field) == (3, "position")
    assert "[0] is 0.0 against 0.5, 1 of 3 differ" in stream.first.detail


def test_messages_missing_on_either_side_are_paired_by_stamp(record: Callable[..., Path]) -> None:
    a = record([("s", pose(i)) for i in (1, 2, 4, 5)], name="a.mcap")
    b = record([("s", pose(i)) for i in (1, 3, 4, 5, 6)], name="b.mcap")
    [stream] = compare(a, b).streams
    assert (stream.missing_in_a, stream.missing_in_b, stream.differing) == (2, 1, 0)
    assert stream.first is not None
    assert (stream.first.stamp, stream.first.detail) == (2, "message 1 is only in A")
    assert not compare(a, b, tolerance=1e9).same


def test_streams_of_one_side_only_differ(record: Callable[..., Path]) -> None:
    a = record([("both", pose(1)), ("left", pose(1))], name="a.mcap")
    b = record([("both", pose(1)), ("right", pose(1))], name="b.mcap")
    report = compare(a, b)
    assert {s.stream: s.outcome for s in report.streams} == {"both": "same", "left": "only in A", "right": "only in B"}
    assert not report.same
    assert compare(a, b, streams=["both"]).same
    with pytest.raises(RecordingError, match=r"neither .* holds a stream 'middle'"):
        compare(a, b, streams=["middle"])


def one(record: Callable[..., Path], left: Message, right: Message, tolerance: float | None) -> Any:
    a, b = record([("s", left)], name="a.mcap"), record([("s", right)], name="b.mcap")
    [stream] = compare(a, b, tolerance=tolerance).streams
    return stream


@pytest.mark.parametrize(
    ("gap", "tolerance", "outcome"),
    [(0.25, None, "different"), (0.25, 0.2, "different"), (0.25, 0.25, "within tolerance"), (0.0, 0.0, "same")],
)
def test_tolerance_is_absolute_and_inclusive(
    gap: float, tolerance: float | None, outcome: str, record: Callable[..., Path]
) -> None:
    assert one(record, pose(1), pose(1, x=gap), tolerance).outcome == outcome


def depth(*values: float) -> DepthImage:
    return DepthImage(stamp=1, frame="c", data=np.array([values], np.float32))


@pytest.mark.parametrize(
    ("left", "right", "outcome"),
    [
        (depth(np.nan, 1), depth(np.nan, 1.5), "within tolerance"),
        (depth(np.inf), depth(np.inf), "same"),
        (depth(np.nan), depth(1.0), "different"),
        (depth(np.inf), depth(-np.inf), "different"),
        (depth(0.0), depth(-0.0), "same"),
        (depth(1.0), depth(1.0, 1.0), "different"),
        (Image(stamp=1, frame="c", data=[[1]]), Image(stamp=1, frame="c", data=[[2]]), "different"),
        (depth(1.0), depth(1.0).replace(frame="d"), "different"),
    ],
    ids=["NaN beside NaN", "inf", "NaN beside 1", "inf beside -inf", "-0", "shapes", "integers", "strings"],
)
def test_with_a_tolerance(left: Message, right: Message, outcome: str, record: Callable[..., Path]) -> None:
    assert one(record, left, right, 1.0).outcome == outcome


def test_without_a_tolerance_negative_zero_and_nan_payloads_count(record: Callable[..., Path]) -> None:
    payload = np.array([[0x7FC00001]], np.uint32).view(np.float32)
    assert one(record, depth(0.0), depth(-0.0), None).outcome == "different"
    stream = one(record, depth(np.nan), DepthImage(stamp=1, frame="c", data=payload), None)
    assert (stream.outcome, stream.max_difference) == ("different", 0.0)


def test_absent_fields_and_other_types_are_reported_as_differences(record: Callable[..., Path]) -> None:
    scan = LaserScan(stamp=1, frame="l", angle_min=0.0, angle_max=1.0, ranges=[1.0], intensities=[5.0])
    stream = one(record, scan, scan.replace(intensities=None), 1.0)
    assert stream.first is not None
    assert (stream.first.field, stream.first.detail) == ("intensities", "float32[1] against None")
    stream = one(record, scan, pose(1), 1.0)
    assert stream.first is not None
    assert stream.first.detail == "LaserScan against Pose"


def test_streams_without_a_type_are_compared_by_bytes(tmp_path: Path) -> None:
    for name, payload in (("a", b"xy"), ("b", b"xz")):
        blobs = [(i, payload if i == 1 else b"same") for i in range(3)]
        foreign(tmp_path / name, ("/blob", "cbor", None, blobs))
    assert compare(tmp_path / "a", tmp_path / "a").same
    [stream] = compare(tmp_path / "a", tmp_path / "b").streams
    assert (stream.outcome, stream.differing, stream.first and stream.first.stamp) == ("different", 1, 1)


@pytest.mark.parametrize("tolerance", [-1.0, float("nan"), float("inf")])
def test_a_senseless_tolerance_is_refused(tolerance: float, record: Callable[..., Path]) -> None:
    path = record([])
    with pytest.raises(RecordingError, match="tolerance must be a finite number"):
        compare(path, path, tolerance=tolerance)


def test_the_report_is_json(record: Callable[..., Path]) -> None:
    a, b = record([("s", depth(1.0))], name="a.mcap"), record([("s", depth(np.nan))], name="b.mcap")
    report = compare(a, b, tolerance=1.0)
    value = json.loads(json.dumps(report.as_json(), allow_nan=False))
    assert value["same"] is False
    assert value["streams"][0]["max_difference"] == "Infinity"
    assert value["streams"][0]["first"]["field"] == "data"
    assert "[0, 0] is 1.0 against nan" in value["streams"][0]["first"]["detail"]


def test_integers_differ_exactly_however_far_apart(record: Callable[..., Path]) -> None:
    low, high = -(2**63) + 1, 2**63 - 1
    ticks = WheelTicks(stamp=1, names=["left", "right"], ticks=[low, high])
    assert one(record, ticks, ticks.replace(ticks=[low, high - 1]), 5.0).max_difference == 1.0
    assert one(record, ticks, ticks.replace(ticks=[high, high]), None).max_difference == float(high - low)
