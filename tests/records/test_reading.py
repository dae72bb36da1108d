"""The firing records of a recording are read in one pass, and what cannot be read names file and operator."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from dataflow.recording import Recording, RecordingError
from dataflow.records.firing import FiringRecord, encode_batch
from dataflow.records.reading import FiringLog, recorded_firings, whole

KEPT = Path(__file__).resolve().parent.parent / "recordings_of" / "live.mcap"


def record(operator: str, index: int, incarnation: int = 0) -> FiringRecord:
    return FiringRecord(operator, incarnation, index, "setup" if index == 0 else "fire", index)


def test_one_pass_gives_what_asking_for_each_operator_gives() -> None:
    passes = Counter[str]()

    class Counted(Recording):
        def firings(self, operator: str | None = None) -> Iterator[tuple[str, bytes]]:
            passes[operator or "all"] += 1
            return super().firings(operator)

    with Counted(KEPT) as recording:
        log = FiringLog.read(recording)
        found = {name: log.of(name) for name in log.operators}
        assert passes == {"all": 1}
        assert found == {name: tuple(recorded_firings(recording, name)) for name in recording.firing_batches()}
    assert log.of("nobody") == ()


def test_a_batch_that_is_none_names_file_and_operator() -> None:
    log = FiringLog({"a": [encode_batch([record("a", 0)]), b"\xc1"]}, "run.mcap")

    with pytest.raises(RecordingError, match=r"run\.mcap: firing records of operator 'a' are damaged: not a batch"):
        log.of("a")


def test_a_batch_of_another_operator_is_refused() -> None:
    log = FiringLog({"a": [encode_batch([record("b", 0)])]}, "run.mcap")

    with pytest.raises(RecordingError, match="of operator 'b' is filed under 'a'"):
        log.of("a")


def test_records_after_a_gap_are_left_out_until_the_next_incarnation() -> None:
    places = [(0, 0), (0, 1), (0, 3), (0, 4), (1, 0), (1, 1), (1, 1)]
    kept, lost = whole(record("a", index, incarnation) for incarnation, index in reversed(places))

    assert [(r.incarnation, r.index) for r in kept] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert lost == 2
