"""The books of a recording agree with a list of all its firing records, in a fraction of the memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.graph import load_graph
from dataflow.recording import RecordingError
from dataflow.records.firing import CALLS, Emission, FiringRecord, encode_batch
from dataflow.records.reading import FiringLog, whole
from dataflow.sync import MessageRef
from dataflow.verification.record_totals import GraphRecordTotals, MessageSet

MIXED = Path(__file__).resolve().parent.parent / "runtime" / "mixed.yaml"
numbers = st.integers(0, 3000) | st.integers(0, 12)
places = st.lists(st.tuples(st.integers(0, 2), numbers), max_size=40)


def places_of(found: list[tuple[int, int]]) -> MessageSet:
    made = MessageSet()
    for place in found:
        made.add(*place)
    return made


@given(places, places, st.none() | st.tuples(st.integers(0, 1), numbers))
def test_places_are_a_set(
    some: list[tuple[int, int]], others: list[tuple[int, int]], since: tuple[int, int] | None
) -> None:
    one, other = places_of(some), places_of(others)

    expected = {place for place in set(some) - set(others) if since is None or place >= since}
    assert one.beyond(other, since) == len(expected)
    assert [place in one for place in others] == [place in set(some) for place in others]
    assert {life: count for life, count in one.counts().items() if count} == {
        life: len({seq for at, seq in some if at == life}) for life, _ in some
    }


def test_a_set_of_messages_that_follow_each_other_takes_a_fraction_of_a_byte_each() -> None:
    one = places_of([(0, seq) for seq in range(100_000)])

    assert one.counts() == {0: 100_000}
    assert len(one._pages) < 100


@given(st.data())
def test_the_book_of_an_operator_is_that_of_all_its_records_wherever_they_lie(data: st.DataObject) -> None:
    kinds = data.draw(st.lists(st.sampled_from(["setup", "fire", "fire", "tick", "param", "finish"]), max_size=12))
    ported = len(load_graph(MIXED).nodes["smooth"].outputs)
    records = [
        FiringRecord(
            "smooth",
            incarnation=index // 7,
            index=index % 7,
            kind=kind,
            stamp=index,
            inputs={"x": MessageRef("test/mix/mixed", 0, index)} if kind in CALLS else {},
            outputs=(Emission(index, index, b"d"),) * ported if kind in CALLS else (),
            duration=5,
        )
        for index, kind in enumerate(kinds)
    ]
    kept = [record for record in records if data.draw(st.integers(0, 9))]
    laid = data.draw(st.permutations(kept + kept[:2])) if data.draw(st.booleans()) else kept
    graph = load_graph(MIXED)
    books = GraphRecordTotals(FiringLog({"smooth": [encode_batch([r]) for r in laid]}, "run.mcap"), graph)

    book, (repeated, lost) = books.of("smooth"), whole(laid)
    assert book.lost == lost
    assert book.records == len(laid)
    assert book.duration == 5 * len(laid)
    assert book.calls == sum(r.kind in CALLS for r in laid)
    assert book.only_calls == (
        bool(repeated) and not lost and repeated[0].kind == "setup" and all(r.kind in CALLS for r in repeated[1:])
    )
    calls = [r for r in laid if r.kind in CALLS]
    last = max(calls, key=lambda r: (r.incarnation, r.index), default=None)
    assert book.finished == (last is not None and last.kind == "finish")
    made = places_of([(r.incarnation, r.outputs[0].seq) for r in laid if r.outputs and r.outputs[0] is not None])
    (stream, *_) = graph.nodes["smooth"].outputs.values()
    assert book.made[stream].counts() == made.counts()
    assert books.taken["test/mix/mixed"].counts() == places_of([(0, r.stamp) for r in laid if r.inputs]).counts()


def test_a_parameter_that_lies_before_the_finish_which_it_followed_does_not_hide_it() -> None:
    kinds = {2: "param", 0: "setup", 1: "finish"}
    laid = [FiringRecord("smooth", 0, index, kind, 0) for index, kind in kinds.items()]
    books = GraphRecordTotals(FiringLog({"smooth": [encode_batch([r]) for r in laid]}, "run.mcap"), load_graph(MIXED))
    assert books.of("smooth").finished


def test_an_error_does_not_grow_each_time_that_it_is_raised() -> None:
    books = GraphRecordTotals(FiringLog({"smooth": [b"no batch"]}, "run.mcap"), load_graph(MIXED))
    depths = []
    for _ in range(3):
        with pytest.raises(RecordingError, match="damaged") as found:
            books.of("smooth")
        depths.append(len(found.traceback))
    assert len(set(depths)) == 1
