"""Reading record by record repeats what a list of all records of an operator would."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.mcap.chunks import Chunks
from dataflow.records.cuts import ResumePoint, cut_record, is_known, taken_by
from dataflow.records.firing import CALLS, FiringRecord, Kind, encode_batch
from dataflow.records.order import Outline, Run
from dataflow.records.reading import FiringLog, whole
from dataflow.records.repetition import Repetition, look_at
from dataflow.sync import MessageRef, Uses

TAKEN = {"left_out": 1, "again": False, "params": [{}, {}]}
DETAILS: dict[str, list[dict[str, Any]]] = {
    "cut": [{}, TAKEN, {**TAKEN, "state": b"s"}],
    "snapshot": [{"state": b"s"}, {"left_out": 5}],
}
kinds: st.SearchStrategy[Kind] = st.sampled_from(["setup", "fire", "fire", "tick", "param", "reset", "snapshot", "cut"])


@st.composite
def recorded(draw: st.DrawFn) -> list[FiringRecord]:
    """Records in order, some of them missing."""
    found = []
    for number, kind in enumerate(draw(st.lists(kinds, max_size=20))):
        detail = draw(st.sampled_from(DETAILS.get(kind, [{}])))
        inputs = {"x": MessageRef("s", 0, draw(st.integers(0, 5)))} if kind in CALLS else {}
        place = divmod(number, 9)
        found.append(FiringRecord("a", *place, kind, 10 * number, inputs=inputs, detail=detail))
    return [record for record in found if draw(st.integers(0, 11))]


def listed(
    records: Sequence[FiringRecord], begin: int | None, *, stateless: bool
) -> tuple[list[FiringRecord], list[FiringRecord], int]:
    """The records before the place from which they are repeated, those that are, and the calls at an unknown state."""
    kept, _ = whole(records)
    kept = kept[1:] if kept and kept[0].kind == "setup" else kept
    place = 0
    if begin is not None and stateless:
        place = next((k for k, r in enumerate(kept) if r.kind in CALLS and r.stamp >= begin), len(kept))
    elif begin is not None:
        place = max((k + 1 for k, r in enumerate(kept) if is_known(r) and r.stamp <= begin), default=0)
    repeated, unknown, lost = list[FiringRecord](), 0, False
    for record in kept[place:]:
        if record.kind == "cut" and taken_by(record) is not None:
            lost = "state" not in record.detail
        restores = lost and record.kind == "snapshot" and is_known(record)
        lost = lost and record.kind != "setup" and not restores
        if lost and not stateless and record.kind in (*CALLS, "reset"):
            unknown += record.kind in CALLS
        else:
            repeated.append(replace(record, kind="restore") if restores and not stateless else record)
    return kept[:place], repeated, unknown


@given(recorded(), st.none() | st.integers(0, 200), st.booleans())
def test_it_is_that_of_the_list(records: list[FiringRecord], begin: int | None, stateless: bool) -> None:
    before, repeated, unknown = listed(records, begin, stateless=stateless)

    found = Repetition(lambda: records, begin=begin, stateless=stateless)
    look_at([found])

    calls = [record for record in repeated if record.kind in CALLS]
    assert list(found) == repeated
    assert (found.calls, found.lost, found.unknown) == (len(calls), whole(records)[1], unknown)
    assert found.before[-1:] == before[-1:]
    assert [r for r in found.before if r.kind in ("setup", "param", "cut")] == [
        r for r in before if r.kind in ("setup", "param", "cut")
    ]
    taken = Counter(r.inputs["x"].seq for r in calls if isinstance(r.inputs["x"], MessageRef))
    assert found.needed == ({"s": (0, min(taken))} if taken else {})
    assert [found.uses.left("s", 0, seq) for seq in range(6)] == [bool(taken[seq]) for seq in range(6)]


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 2000), st.sampled_from([1, 2, 254, 255, 256, 600]))))
def test_a_message_is_left_until_its_last_use(told: list[tuple[int, int, int]]) -> None:
    uses, expected = Uses(), Counter[MessageRef]()
    for life, seq, times in told:
        for _ in range(times):
            uses.add({"x": MessageRef("s", life, seq)})
        expected[MessageRef("s", life, seq)] += times

    for message, times in expected.items():
        assert uses.left("s", message.incarnation, message.seq)
        assert [uses.take(message) for _ in range(times)] == [False] * (times - 1) + [True]
        assert not uses.left("s", message.incarnation, message.seq)
    assert not uses.left("other", 0, 0)


def test_each_incarnation_is_repeated_with_its_own_code() -> None:
    """The second one was a restart by a new process, which had the edited files; a reload replaced its code alone."""
    first, second, third = ({"m": letter} for letter in "abc")
    kinds: list[Kind] = ["setup", "setup", "reset", "setup", "setup"]
    details = [{"code": first}, {"code": second}, {}, {"code": third}, {"code": third}]
    records = [FiringRecord("a", k, 0, kind, k, detail=details[k]) for k, kind in enumerate(kinds)]
    repetition = Repetition(lambda: records, stateless=False)
    look_at([repetition])
    assert [repetition.code_of(k) for k in range(5)] == [first, second, second, None, None]

    records[1] = cut_record(records[1], left_out=3, taken=ResumePoint(True, {}, {}, b"s", second), held=(), stamp=1)
    repetition = Repetition(lambda: [*records[:2], *records[3:]], stateless=False)
    look_at([repetition])
    assert [repetition.code_of(k) for k in range(5)] == [first, second, second, None, None]


def test_code_that_is_none_is_left_alone() -> None:
    for code in ("/dev/zero", [], {"m": 3}, {3: "m"}):
        records = [FiringRecord("a", k, 0, "setup", k, detail={"code": c}) for k, c in enumerate((code, {"m": "a"}))]
        repetition = Repetition(lambda records=records: records, stateless=False)
        look_at([repetition])
        assert repetition.code_of(0) is None


def test_records_of_several_operators_are_read_in_one_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They lie in the same chunks; what is decompressed is let go long before the end of a long recording."""
    makers = [SimpleNamespace(name=name, outputs={"out": f"g/{name}/out"}) for name in "abc"]
    with RecordingWriter(tmp_path / "run.mcap", metadata={}, namespace="g", chunk_seconds=1e9) as writer:
        for index in range(40):
            for maker in makers:
                record = FiringRecord(maker.name, 0, index, "fire" if index else "setup", 10 * index)
                writer.write_firings(maker.name, 10 * index, encode_batch([record]))
            writer.flush()
    decompressed: list[int] = []
    decompress = Chunks._decompress

    def noting(chunks: Chunks, number: int) -> bytes:
        decompressed.append(number)
        return decompress(chunks, number)

    monkeypatch.setattr(Chunks, "_decompress", noting)
    monkeypatch.setattr("dataflow.recording.mcap.cache.KEPT_BYTES", 1000)

    with Recording(tmp_path / "run.mcap") as recording:
        outlines = {maker.name: Outline((Run(0, 40, (0, 0)),)) for maker in makers}
        log = FiringLog({}, "run.mcap", recording, outlines=outlines)
        repetitions = [Repetition(partial(log.ordered, maker), stateless=False) for maker in makers]
        look_at(repetitions)

    assert [repetition.calls for repetition in repetitions] == [39, 39, 39]
    assert sorted(decompressed) == list(range(40))
