"""Recordings that were made once and are kept: they open, hold the same streams, replay and verify, for ever.

`run.mcap` is a run and `live.mcap` a live run of `robot.yaml`, both of file format 1; the live one has drops, timeouts,
late messages, a changed parameter, an operator that raised, a process that was killed, and a clock that jumped back.
`perception.mcap` is 0.6 s of `graphs/perception.yaml`; operators of it may be deleted, and the others go on verifying.
"""

from __future__ import annotations

import shutil
import sys
from collections import Counter
from pathlib import Path

import pytest

from dataflow.graph.model import import_operator
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.supervision.run import replay
from dataflow.verification.verify import verify

HERE = Path(__file__).resolve().parent

SENSORS = {
    "kept/robot/image": "6c8eec1c2484c5ab5f634c27670b4074",
    "kept/robot/imu": "1d1f44b87c6308cbba8f1a9776de1120",
    "kept/robot/mounting": "9e2b9cd7d7da4725600079f3c6740817",
    "kept/robot/odometry": "fe0fb8cc09e3aaca70a3cb292837151f",
}
DIGESTS = {
    "run.mcap": SENSORS
    | {
        "kept/beacon/signal": "f0a1837403e587d8b15d9f5995705be9",
        "kept/busy/y": "5d28093303984ecac2f5aead82072329",
        "kept/look/seen": "f40e144e3c77637ad5e54fbc3a851cb3",
        "kept/smooth/mean": "581ac1c05e95ab72b090c0f8969b7114",
    },
    "live.mcap": SENSORS
    | {
        "kept/@/diagnostics": "cc2385652134cf4be0c7c5378d865d81",
        "kept/beacon/signal": "25bbffff781b3801df4d6a694637863f",
        "kept/busy/y": "276298522e5457940b231e5742abdda0",
        "kept/look/seen": "284591637de2e9f29260e5c39f4f9c44",
        "kept/smooth/mean": "768dfb1c4e957b389f6c0b4d4bbc5537",
    },
}
VERIFIED = {
    "run.mcap": {"look": 31, "smooth": 49, "busy": 151, "tally": 151},
    "live.mcap": {"look": 22, "smooth": 42, "busy": 117, "tally": 122},
}
FILES = sorted(DIGESTS)
OPERATORS = ("Robot", "Beacon", "Look", "Smooth", "Busy", "Tally")


@pytest.mark.parametrize("file", FILES)
def test_a_kept_recording_opens_and_its_streams_have_the_digests_they_had(file: str) -> None:
    with Recording(HERE / file) as recording:
        assert not recording.torn
        assert recording.digests() == recording.metadata["digests"] == DIGESTS[file]


def test_the_kept_live_recording_holds_what_live_runs_do() -> None:
    with Recording(HERE / "live.mcap") as recording:
        events = Counter(event.name for event in recording.events())
        incarnations = {name: info.incarnations for name, info in recording.streams.items() if info.incarnations > 1}

    assert events == {"fault": 6, "restart": 2, "restarted": 1, "clock_jump": 1}
    assert incarnations == {"kept/beacon/signal": 2, "kept/busy/y": 2, "kept/smooth/mean": 2}


def test_the_kept_run_replays_with_the_same_digests() -> None:
    assert replay(HERE / "run.mcap", placement="one_process").digests() == DIGESTS["run.mcap"]


@pytest.mark.parametrize("file", FILES)
def test_a_kept_recording_verifies_as_identical(file: str) -> None:
    report = verify(HERE / file)

    assert report.identical, report.as_json()
    assert {v.operator: v.verified for v in report.operators} == VERIFIED[file]


def test_the_kept_run_verifies_from_its_middle_by_a_recorded_state() -> None:
    report = verify(HERE / "run.mcap", start=0.9)

    assert report.identical, report.as_json()
    assert {v.operator: v.began for v in report.operators}["smooth"] == "snapshot"


def test_the_kept_run_verifies_with_operators_that_have_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(HERE / "kept_operators.py", tmp_path / "kept_elsewhere.py")
    moved = {f"kept_operators:{name}": f"kept_elsewhere:{name}" for name in OPERATORS}
    (tmp_path / "kept_operators.py").write_text(f"MOVED_OPERATORS = {moved}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "kept_operators", raising=False)

    report = verify(HERE / "run.mcap", start=0.9)

    assert report.identical, report.as_json()
    assert {v.operator: v.began for v in report.operators}["smooth"] == "snapshot"
    with Recording(HERE / "run.mcap") as recording:
        nodes = recorded_graph(recording).nodes.values()
    assert {node.use for node in nodes} == set(moved.values())
    assert {import_operator(former) for former in moved} == {node.operator for node in nodes}
    del sys.modules["kept_operators"]


DELETED = {"perception/focus", "perception/names"}
"""Operators of `perception.mcap` that were deleted since. Others lack parameters of then."""
UNCHANGED = {"perception/image_watch", "perception/depth_watch", "perception/scan_watch"}
"""Operators that only count and compare. Others round as the kernels for a CPU do, or have changed since."""


@pytest.mark.long
def test_the_kept_perception_verifies_but_for_operators_that_were_deleted() -> None:
    report = verify(HERE / "perception.mcap")

    assert report.absent.keys() >= DELETED
    assert all("has no parameter" in report.absent[name] for name in report.absent.keys() - DELETED), report.absent
    assert {v.operator for v in report.operators if v.verdict == "identical"} >= UNCHANGED
    unverifiable = {v.operator for v in report.operators if v.verdict == "unverifiable"}
    assert unverifiable <= {"perception/postures"}  # whose input was not recorded, and is made by one that is gone
    assert all(v.verified == v.firings for v in report.operators if v.operator not in unverifiable)
