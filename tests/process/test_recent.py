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


def test_what_is_no_firing_or_has_failed_is_left_out() -> None:
    found = kept(call(0, kind="setup"), call(1), call(2, kind="snapshot"), call(3), call(4, outcome="error"), call(5))

    assert [record.index for record in found] == [1, 3, 5]


def test_firings_of_long_ago_are_left_out() -> None:
    assert [r.index for r in kept(call(0, ago=OVER + 1), call(1, ago=OVER - 1), call(2))] == [1, 2]


def test_nothing_is_answered_before_the_first_firing() -> None:
    assert kept() == []
