"""Parts of recordings: they hold the span, replay as the whole does there, and verify from recorded states on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_parts import cut, messages
from mcap.reader import make_reader
from mcap.writer import Writer
from tampering import tampered

from dataflow.editing.part import Part, write_part
from dataflow.editing.spans import RunRecords, folded, listed
from dataflow.interop.opening import is_foreign
from dataflow.recording import Recording
from dataflow.recording.streams.copying import Origin
from dataflow.records.cuts import ResumePoint, taken_by
from dataflow.records.firing import CALLS, Emission, FiringRecord
from dataflow.records.reading import FiringLog, recorded_firings, whole
from dataflow.supervision.run import replay
from dataflow.sync import MessageRef
from dataflow.verification.verify import verify

pytestmark = pytest.mark.usefixtures("in_process")

SECOND = 1_000_000_000


def test_a_part_holds_the_span_byte_for_byte(recorded: Path, tmp_path: Path) -> None:
    part = cut(recorded, tmp_path / "part.mcap", 0.4, 0.7, bare=True)

    with Recording(recorded) as whole_file, Recording(part) as cut_file:
        first = min(s.first for s in whole_file.streams.values() if s.first and not s.static)
        low, high = first + round(0.4 * SECOND), first + round(0.7 * SECOND)
        expected = [(r.stream, r.sequence, r.data) for r in whole_file.raw(start=low, end=high)]
        static = [s.name for s in whole_file.streams.values() if s.static]
        found = [(r.stream, r.sequence, r.data) for r in cut_file.raw() if r.stream not in static]
        assert {s for s in static if cut_file.counts(s)} == {s for s in static if whole_file.counts(s)}
    assert found == expected


@pytest.mark.long
def test_replay_of_a_part_equals_that_of_the_whole(stateful: Path, tmp_path: Path) -> None:
    part = cut(stateful, tmp_path / "part.mcap", 0.5, 0.8)

    again, there = tmp_path / "again.mcap", tmp_path / "there.mcap"
    replay(part, placement="one_process", record=again)
    replay(stateful, start=0.5, end=0.8, placement="one_process", record=there)

    assert messages(again) == messages(there)
    assert len(messages(again)["test/second/y"]) > 10


def test_part_verifies_from_recorded_states_and_reports_the_rest(recorded: Path, tmp_path: Path) -> None:
    report = verify(cut(recorded, tmp_path / "part.mcap", 0.5, 0.8))

    found = {v.operator: v for v in report.operators}
    assert not report.identical
    assert report.cut
    assert not report.culprits
    assert found["tuned"].verdict == "identical"
    assert found["tuned"].began == "snapshot"
    assert found["smooth"].verdict == "unverifiable"  # it has a state and gives no snapshot
    assert found["smooth"].unknown == found["smooth"].firings > 0
    assert all(s.whole for s in report.stand_ins)
    assert not [s for s in report.stored if not s.as_recorded or s.missing]
    assert not any(v.not_stored or v.unaccounted or v.lost_records for v in report.operators)


def test_only_the_end_cut_off_verifies_wholly_up_to_there(recorded: Path, tmp_path: Path) -> None:
    report = verify(cut(recorded, tmp_path / "part.mcap", None, 0.8))

    assert {v.verdict for v in report.operators} == {"identical"}
    assert report.cut
    assert not report.identical  # of the run's end nothing is known


@pytest.mark.long
def test_a_cut_that_cuts_nothing_off_is_the_whole(recorded: Path, tmp_path: Path) -> None:
    copy = cut(recorded, tmp_path / "copy.mcap", None, None)

    assert messages(copy) == messages(recorded)
    assert verify(copy).identical
    with Recording(copy) as one, Recording(recorded) as other:
        assert one.metadata == other.metadata


@pytest.mark.parametrize("path", ["kept", "live"])
@pytest.mark.parametrize(("start", "end"), [(0.3, None), (None, 0.9), (0.5, 1.0), (0.75, 0.8)])
def test_no_cut_blames_an_operator_or_loses_an_account(
    path: str, start: float | None, end: float | None, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    report = verify(cut(request.getfixturevalue(path), tmp_path / "part.mcap", start, end), jobs=1)

    assert not report.culprits
    assert not report.identical
    assert {v.verdict for v in report.operators} <= {"identical", "unverifiable"}
    assert all(v.unknown for v in report.operators if v.verdict == "unverifiable")
    assert not any(v.unaccounted or v.unverifiable or v.lost_records for v in report.operators)
    assert all(s.whole and not s.unaccounted for s in report.stand_ins)


def test_a_part_of_a_part_is_the_part_that_it_would_be_of_the_whole(recorded: Path, tmp_path: Path) -> None:
    once = cut(recorded, tmp_path / "once.mcap", 0.5, 0.7)
    first = cut(recorded, tmp_path / "first.mcap", 0.3, None)
    with Origin(first) as origin, Origin(recorded) as whole_file:
        base = whole_file.span()[0]
        write_part(origin, Part(base + SECOND // 2, base + 7 * SECOND // 10), tmp_path / "twice.mcap")

    assert messages(tmp_path / "twice.mcap") == messages(once)
    verdicts = [
        {v.operator: (v.verdict, v.verified, v.began) for v in verify(p).operators}
        for p in (once, tmp_path / "twice.mcap")
    ]
    assert verdicts[0] == verdicts[1]


def test_a_changed_message_of_a_part_is_found_and_a_lost_record_too(recorded: Path, tmp_path: Path) -> None:
    part = cut(recorded, tmp_path / "part.mcap", 0.5, 0.8)

    def without(record: FiringRecord) -> bool:
        return not (record.operator == "tuned" and record.kind in CALLS and record.index % 7 == 0)

    lacking = verify(tampered(part, tmp_path / "lacking.mcap", records=without), only=["tuned"]).operators[0]
    assert lacking.lost_records
    assert lacking.verdict == "unverifiable"


def test_a_state_in_the_part_is_taken_up_where_there_was_none_at_the_cut(recorded: Path, tmp_path: Path) -> None:
    report = verify(cut(recorded, tmp_path / "part.mcap", 0.1, None), only=["tuned"])

    (tuned,) = report.operators
    assert tuned.unknown > 0  # up to its first state, at 0.2 s
    assert tuned.verified > tuned.unknown
    assert tuned.verdict == "unverifiable"


@given(
    calls=st.lists(st.integers(1, 5), min_size=1, max_size=12),
    states=st.sets(st.integers(0, 11)),
    start=st.integers(0, 60),
    length=st.integers(0, 60),
    reach=st.integers(1, 4),
)
@settings(max_examples=150, deadline=None)
def test_every_message_that_a_kept_firing_takes_is_kept_or_accounted_for(
    calls: list[int], states: set[int], start: int, length: int, reach: int
) -> None:
    """A source feeds an operator that takes the last messages; what the part holds must explain all of it."""
    made, taken, stamp = [record("cam", 0, "setup")], [record("op", 0, "setup")], 0
    for k, step in enumerate(calls):
        stamp += step
        made.append(record("cam", k + 1, "fire", stamp, outputs=(Emission(k, stamp, bytes(16)),)))
        refs = {f"i{n}": MessageRef("s", 0, k - n) for n in range(reach) if k >= n}
        taken.append(record("op", len(taken), "fire", stamp, inputs=refs))
        if k in states:
            taken.append(record("op", len(taken), "snapshot", stamp, detail={"state": b"x"}))
    end = start + length

    log = {"cam": listed(made), "op": listed(taken)}
    part = RunRecords(log, {"cam": ("s",)}).of_span({"s"}, start, end, lambda _: (start, end))

    stored = {e.seq for r in made for e in r.outputs if e and start <= e.stamp <= end}
    extra = {e.seq for r in made for e in r.outputs if e and e.stamp in part.needed.get("s", {}).get(0, ())}
    told = {e.seq for r in part.records["cam"] for e in r.outputs if e}
    told |= {held[2] for r in part.records["cam"] if r.kind == "cut" for held in r.detail["held"]}
    used = {ref.seq for r in part.records["op"] for ref in r.inputs.values()}
    assert used <= stored | extra == told
    assert {r.index for r in taken if r.kind in CALLS and start <= r.stamp <= end} <= {
        r.index for r in part.records["op"]
    }
    for records in part.records.values():
        assert whole(records)[1] == 0


def record(operator: str, index: int, kind: str, stamp: int = -1, **fields: object) -> FiringRecord:
    return FiringRecord(operator, 0, index, kind, stamp, **fields)


def test_firings_keep_their_numbers(recorded: Path, tmp_path: Path) -> None:
    part = cut(recorded, tmp_path / "part.mcap", 0.5, 0.8)

    with Recording(recorded) as one, Recording(part) as other:
        calls = [
            {r.index: (r.stamp, r.outputs) for r in recorded_firings(recording, "merge") if r.kind in CALLS}
            for recording in (one, other)
        ]
        assert FiringLog.read(other).operators == FiringLog.read(one).operators
    assert calls[1].items() < calls[0].items()


def test_another_programs_file_keeps_its_writer_its_latched_topics_and_its_times(tmp_path: Path) -> None:
    """Bytes, publication times, schemas and attachments go over."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="another program")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        moving, fixed = (writer.register_channel(t, "cdr", schema) for t in ("/said", "/tf_static"))
        writer.add_message(fixed, 100, b"fixed", 90)
        for k in range(10):
            writer.add_message(moving, 1000 + k, b"%d" % k, 900 + k, k)
        writer.add_attachment(1, 1, "notes", "text/plain", b"hello")
        writer.finish()

    with Origin(path) as origin:
        done = write_part(origin, Part(1004, 1007), tmp_path / "part.mcap")

    with (tmp_path / "part.mcap").open("rb") as file:
        reader = make_reader(file)
        found = [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]
        header = reader.get_header()
    assert found == [
        ("/tf_static", 100, 90, 0, b"fixed"),
        *(("/said", 1000 + k, 900 + k, k, b"%d" % k) for k in range(4, 8)),
    ]
    assert (header.profile, header.library) == ("ros2", "another program")
    assert is_foreign(tmp_path / "part.mcap")
    assert (done.attachments, done.notes) == (1, [])


def test_a_part_keeps_the_code_of_a_setup_that_it_leaves_out() -> None:
    setups = [replace(record("op", 0, "setup", detail={"code": {"m": str(k)}}), incarnation=k) for k in range(3)]
    _, cut = folded([*setups, replace(record("op", 5, "fire", 5), incarnation=2)])

    taken = taken_by(cut)
    assert taken is not None
    assert (cut.incarnation, taken.again, taken.code) == (2, True, {"m": "2"})


def test_a_state_that_was_too_large_to_be_kept_stands_in_for_no_calls() -> None:
    """Its record tells its size under the name that a `cut` has for calls: a recorder of parts ended with an error."""
    large = record("op", 2, "snapshot", 2, detail={"left_out": 600_000_000})
    records = [record("op", 0, "setup"), record("op", 1, "fire", 1), large]

    assert taken_by(large) is None
    setup, cut = folded(records)
    assert (setup.kind, cut.kind, cut.index) == ("setup", "cut", 2)
    assert taken_by(cut) == ResumePoint(again=False, at_setup={}, since={}, state=None)
    part = RunRecords({"op": listed(records)}, {}).of_span((), 2, None, lambda _: (2, None))
    assert part.unknown == ("op",)
