"""The last firings of a process, for those who ask for latencies while it runs."""

from __future__ import annotations

from dataflow.process.streams.recent import KEPT, OVER, RecentFirings
from dataflow.records.firing import FiringRecord, Kind, Outcome, decode_batch
from dataflow.sync import Drop

NOW = 1_700_000_000_000_000_000


def call(index: int, *, ago: float = 0.0, kind: Kind = "fire", outcome: Outcome = "ok") -> FiringRecord:
    """A call of `ago` seconds before `NOW`."""
    drops = (Drop("x", "s", 1, 1, 0, "late", ""),)
    start = NOW - round(ago * 1e9)
    return FiringRecord("op", 0, index, kind, index, outcome=outcome, drops=drops, detail={"a": 1}, wall_start=start)


def kept(*records: FiringRecord) -> list[FiringRecord]:
    recent = RecentFirings()
    for record in records:
        recent.add(record)
    return [record for batch in recent.batches(NOW) for record in decode_batch(batch).records]


def test_the_last_firings_are_answered_without_drops_and_details() -> None:
    found = kept(*(call(k) for k in range(KEPT + 10)))

    assert [record.index for record in found] == list(range(10, KEPT + 10))
    assert not any(record.drops or record.detail for record in found)


def test_recent_firings_omit_failures_and_other_records() -> None:
    found = kept(call(0, kind="setup"), call(1), call(2, kind="snapshot"), call(3), call(4, outcome="error"), call(5))

    assert [record.index for record in found] == [1, 3, 5]


def test_firings_of_long_ago_are_left_out() -> None:
    assert [r.index for r in kept(call(0, ago=OVER + 1), call(1, ago=OVER - 1), call(2))] == [1, 2]


def test_answer_begins_after_the_cursor_and_counts_discarded_records() -> None:
    recent, cursor, told, missed = RecentFirings(), {}, list[int](), list[int]()
    for first, end in ((0, 3), (3, 3), (3, 40), (40, KEPT + 60)):
        for k in range(first, end):
            recent.add(call(k))
        answer = recent.after(cursor)
        cursor = answer["cursor"]
        told += [r.index for batch in answer["batches"] for r in decode_batch(batch).records]
        missed.append(answer["missed"])

    assert missed == [0, 0, 0, 20]
    assert told == [*range(40), *range(60, KEPT + 60)]
    assert answer["full"] == 1.0
    assert RecentFirings().after(cursor)["missed"] == 0


def test_another_process_in_its_place_is_asked_from_its_beginning() -> None:
    before, after = RecentFirings(), RecentFirings()
    after._since = before._since + 1
    for k in range(50):
        before.add(call(k))
    for k in range(KEPT + 5):
        after.add(call(k))
    assert before.after({})["missed"] == 0

    answer = after.after(before.after({})["cursor"])

    assert answer["missed"] == 5
    assert decode_batch(answer["batches"][0]).records[0].index == 5


def test_failure_keeps_the_beginning_of_its_text() -> None:
    recent = RecentFirings()
    recent.add(FiringRecord("op", 0, 0, "fire", 0, outcome="error", detail={"error": "e" * 900, "more": 1}))

    (batch,) = recent.after({})["batches"]

    assert decode_batch(batch).records[0].detail == {"error": "e" * 500}
    assert recent.batches() == []
