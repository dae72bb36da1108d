"""What was changed in a recording, or lost from it, is said by stream and number, and is never called identical."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tampering import Kept, as_it_is, duplicated, ended, tampered

from dataflow.graph import load_text
from dataflow.messages import FeatureVector, Imu, Message
from dataflow.recording import Recorded, Recording
from dataflow.records.firing import FiringRecord
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.supervision.run import replay, run
from dataflow.verification.gate import Checked, check
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")


def checked(path: Path) -> Checked:
    return check(path, path.name, lambda file: verify(file))


def verdicts(one: Checked) -> dict[str, str]:
    assert one.report is not None, one.details or one.error
    return {j.operator: j.verdict for j in one.judged}


def at(stream: str, seq: int, change: Callable[[Recorded], Kept]) -> Callable[[Recorded], Kept]:
    """What is done to one message; the others stay."""
    return lambda found: change(found) if (found.stream, found.seq) == (stream, seq) else as_it_is(found)


def moved(found: Recorded) -> Kept:
    """The message with another value."""
    message: Message = found.message
    if isinstance(message, Imu):
        return [(message.replace(linear_acceleration=np.array([-7.0, 0.0, 9.81])), found.seq)]
    assert isinstance(message, FeatureVector)
    return [(message.replace(vectors=message.vectors + 1), found.seq)]


def test_an_untouched_copy_is_identical(kept: Path, tmp_path: Path) -> None:
    one = checked(tampered(kept, tmp_path / "same.mcap"))

    assert one.verdict == "identical", one.as_json()
    assert set(verdicts(one)) == {"look", "smooth", "busy", "tally"}


@pytest.mark.parametrize("stream", ["kept/look/seen", "kept/busy/y"])  # taken by another operator, taken by a sink
def test_a_stored_output_that_was_changed_is_named_by_stream_and_number(
    kept: Path, tmp_path: Path, stream: str
) -> None:
    one = checked(tampered(kept, tmp_path / "t.mcap", messages=at(stream, 20, moved)))

    maker = stream.split("/")[1]
    assert one.verdict == "different"
    assert not one.passed
    assert verdicts(one)[maker] == "changed"
    assert one.changed == (f"{stream} #20",)
    assert one.culprits == ()


def test_changed_source_message_makes_no_operator_a_culprit(kept: Path, tmp_path: Path) -> None:
    one = checked(tampered(kept, tmp_path / "t.mcap", messages=at("kept/robot/imu", 40, moved)))

    assert one.changed == ("kept/robot/imu #40",)
    assert verdicts(one)["robot"] == "changed"
    assert verdicts(one)["busy"] == "downstream"
    assert one.culprits == ()
    assert one.as_json()["changed"] == ["kept/robot/imu #40"]


def test_a_source_message_that_is_stored_twice_is_noticed(kept: Path, tmp_path: Path) -> None:
    one = checked(duplicated(kept, tmp_path / "t.mcap", "kept/robot/imu", 40))

    assert not one.passed
    assert verdicts(one)["robot"] == "unverifiable"
    assert one.report is not None
    [robot] = [s for s in one.report.stand_ins if s.operator == "robot"]
    assert robot.unaccounted == 1


def test_a_source_message_that_was_added_is_noticed(kept: Path, tmp_path: Path) -> None:
    def added(found: Recorded) -> Kept:
        return [(found.message, 74), (found.message.replace(stamp=found.stamp + 1), 75)]

    one = checked(tampered(kept, tmp_path / "t.mcap", messages=at("kept/robot/odometry", 74, added)))

    assert verdicts(one)["robot"] == "unverifiable"
    assert one.verdict == "not wholly verified"


def test_missing_source_message_that_no_call_took_is_noted(kept: Path, tmp_path: Path) -> None:
    one = checked(tampered(kept, tmp_path / "t.mcap", messages=at("kept/robot/odometry", 74, lambda found: [])))

    assert one.report is not None
    assert one.report.identical  # it may never have been sent
    [robot] = [s for s in one.report.stand_ins if s.operator == "robot"]
    assert robot.missing == 1
    [stream] = [s for s in one.report.stored if s.missing]
    assert (stream.stream, stream.first_missing) == ("kept/robot/odometry", (0, 74))


@pytest.mark.parametrize("lost", [range(20, 24), range(70, 10**6)], ids=["middle", "last"])
def test_messages_that_were_taken_and_not_stored_are_made_again(kept: Path, tmp_path: Path, lost: range) -> None:
    def drop(found: Recorded) -> Kept:
        return [] if found.stream == "kept/look/seen" and found.seq in lost else as_it_is(found)

    one = checked(tampered(kept, tmp_path / "t.mcap", messages=drop))

    assert one.report is not None
    found = {v.operator: v for v in one.report.operators}
    assert found["look"].not_stored == len(range(lost.start, min(lost.stop, found["look"].outputs)))
    assert all(v.verdict == "identical" and v.verified == v.firings for v in found.values()), one.as_json()


def without(operator: str, first: int, last: int) -> Callable[[FiringRecord], bool]:
    return lambda record: record.operator != operator or not first <= record.index <= last


@pytest.mark.long
@pytest.mark.parametrize("operator", ["robot", "beacon", "look", "smooth", "tally"])
@pytest.mark.parametrize(
    ("first", "last"),
    [(0, 10**6), (0, 3), (5, 9), (20, 10**6), (-1, -1)],
    ids=["all", "first", "middle", "last", "none"],
)
def test_lost_firing_records_are_noticed_of_sources_and_operators(
    kept: Path, tmp_path: Path, operator: str, first: int, last: int
) -> None:
    one = checked(tampered(kept, tmp_path / "t.mcap", records=without(operator, first, last)))

    assert one.passed is (first < 0)
    if first >= 0 and one.report is not None:
        assert verdicts(one)[operator] == "unverifiable"


@pytest.mark.parametrize("last", [pytest.param(3, marks=pytest.mark.long), -1], ids=["first", "none"])
def test_lost_records_of_source_without_consumer_are_noticed(tmp_path: Path, last: int) -> None:
    text = """\
graph: two
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 20}}
  sum: {use: runtime_operators:Sum, inputs: {x: left/fast}}
  lonely: {use: runtime_operators:Counter, params: {count: 20}}
"""
    run(load_text(text), record=tmp_path / "run.mcap", placement="one_process")
    one = checked(tampered(tmp_path / "run.mcap", tmp_path / "t.mcap", records=without("lonely", 0, last)))

    assert one.passed is (last < 0)


def test_messages_after_cut_of_source_are_no_loss(kept: Path, tmp_path: Path) -> None:
    path = tampered(
        kept,
        tmp_path / "t.mcap",
        records=lambda r: r.operator != "robot" or r.index < 120,
        metadata=ended("failed: on fire"),
    )

    one = checked(path)

    assert one.passed
    assert one.report is not None
    [robot] = [s for s in one.report.stand_ins if s.operator == "robot"]
    assert robot.cut
    assert robot.unaccounted > 0


def test_run_without_calls_does_not_pass(kept: Path, tmp_path: Path) -> None:
    changes: dict[str, Any] = {
        "messages": lambda found: [],
        "records": lambda r: r.kind == "setup",
        "metadata": ended("interrupted"),
    }

    one = checked(tampered(kept, tmp_path / "t.mcap", **changes))

    assert one.verdict == "nothing verified"
    assert not one.passed


GARBAGE = (b"\xc1\xff" + bytes(20), b"", b"\x91" * 5000, b"\x80")
NO_GRAPHS = ("", "5", "[" * 100_000, '{"root": 5}', '{"format": 1, "file": "x", "files": 3}')


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        (
            {
                "messages": lambda found: [],
                "records": lambda r: r.operator == "robot" and r.kind == "setup",
                "metadata": ended("failed: operator 'look' failed in setup()"),
            },
            "recorded run ended before operator 'look' began (its outcome: failed: operator 'look' failed in setup()",
        ),
        ({"metadata": {"dataflow:ends": {"kept/robot/imu": "{"}}}, "how stream 'kept/robot/imu' ended cannot be read"),
        *(({"metadata": {"dataflow:graph": {"bundle": bundle}}}, "graph") for bundle in NO_GRAPHS),
        *(
            (
                {"batches": lambda name, data, of=of, put=put: put if name == of else data},
                f"t.mcap: firing records of operator {of!r} are damaged: not a batch of firing records (",
            )
            for of in ("robot", "look")
            for put in GARBAGE
        ),
    ],
)
def test_damage_is_an_error_of_the_recording(kept: Path, tmp_path: Path, changes: dict[str, Any], error: str) -> None:
    one = checked(tampered(kept, tmp_path / "t.mcap", **changes))

    assert one.report is None
    assert error in one.error
    assert not one.internal


def test_recorded_graph_is_not_read_if_another_is_given(kept: Path, tmp_path: Path) -> None:
    with Recording(kept) as recording:
        graph = recorded_graph(recording)
    path = tampered(kept, tmp_path / "t.mcap", metadata={"dataflow:graph": {"bundle": "no graph"}})

    assert verify(path, graph=graph).identical


@pytest.mark.long
def test_recording_with_gaps_is_replayed_in_processes_as_in_one(kept: Path, tmp_path: Path) -> None:
    def without(found: Recorded) -> Kept:
        return [] if found.stream == "kept/robot/imu" and found.seq in (10, 11, 15) else as_it_is(found)

    path = tampered(kept, tmp_path / "gapped.mcap", messages=without)

    apart = replay(path, placement="process_each")

    assert apart.digests() == replay(path, placement="one_process").digests()
    with Recording(path) as recording:
        assert apart.streams["kept/robot/imu"][0] == recording.streams["kept/robot/imu"].count
