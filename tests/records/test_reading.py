"""The firing records of a recording are read as they are needed, and what cannot be read names file and operator."""

from __future__ import annotations

import gc
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.recording import Recording, RecordingError
from dataflow.records import reading
from dataflow.records.firing import Emission, FiringRecord, encode_batch
from dataflow.records.reading import FiringLog, recorded_firings, whole
from dataflow.records.repetition import Repetition, look_at

KEPT = Path(__file__).resolve().parent.parent / "recordings_of" / "live.mcap"


def sent(operator: str, index: int) -> FiringRecord:
    """A call that sends a message of the same number."""
    return replace(record(operator, index), outputs=(Emission(index, index, bytes([index])),))


def record(operator: str, index: int, incarnation: int = 0) -> FiringRecord:
    return FiringRecord(operator, incarnation, index, "setup" if index == 0 else "fire", index)


def test_reading_operators_one_by_one_or_in_one_pass_gives_the_same_batches() -> None:
    with Recording(KEPT) as recording:
        log = FiringLog.read(recording)
        passed: dict[str, list[bytes]] = {}
        for name, payload in log.all_batches():
            passed.setdefault(name, []).append(payload)

        assert passed == {name: list(log.batches(name)) for name in log.operators}
        assert {name: log.of(name) for name in log.operators} == {
            name: tuple(recorded_firings(recording, name)) for name in recording.firing_batches()
        }
        assert log.of("nobody") == ()
        for first, end in ((0, 2), (1, None), (1, 3), (3, 3)):
            assert list(log.batches("tally", first, end)) == passed["tally"][first:end]


def test_operators_have_one_order_in_every_process() -> None:
    with Recording(KEPT) as recording:
        assert list(FiringLog.read(recording).operators) == sorted(recording.firing_batches())


def test_batches_in_memory_come_before_those_of_the_recording() -> None:
    with Recording(KEPT) as recording:
        stored = list(FiringLog.read(recording).batches("tally"))
        log = FiringLog({"tally": [b"one", b"two"]}, "run.mcap", recording)

        for first, end in ((0, None), (0, 1), (1, 3), (2, 3), (3, None)):
            assert list(log.batches("tally", first, end)) == [b"one", b"two", *stored][first:end]


def test_a_log_reads_the_same_in_another_process() -> None:
    node = SimpleNamespace(name="tally", outputs={})
    with Recording(KEPT) as recording:
        log = FiringLog({}, str(KEPT), recording)
        found = list(log.ordered(node))
        values = msgpack.unpackb(msgpack.packb(log.to_wire()))
        assert values["outlines"]["tally"]["runs"]
        assert list(FiringLog.from_wire(values, recording).ordered(node)) == found


@given(st.data())
def test_records_are_read_in_the_order_of_the_calls_wherever_they_lie(data: st.DataObject) -> None:
    """Each once, and of those handed over twice the first."""
    lengths = data.draw(st.lists(st.integers(1, 4), min_size=1, max_size=6))
    batches, index = [], 0
    for length in lengths:
        made = [sent("a", index + k) for k in range(length)]
        batches.append(made)
        index += length
    again = data.draw(st.lists(st.sampled_from(batches), max_size=3))
    laid = data.draw(st.permutations(batches + again))
    log = FiringLog({"a": [encode_batch(batch) for batch in laid]}, "run.mcap")
    maker = SimpleNamespace(name="a", outputs={"out": "a/out"})

    assert list(log.ordered(maker)) == [record for batch in batches for record in batch]
    assert not log.outline(maker).scattered
    assert list(log.emissions(maker, "a/out")) == [((0, k), bytes([k])) for k in range(index)]


@given(
    st.lists(st.tuples(st.integers(0, 1), st.integers(0, 5), st.binary(min_size=1, max_size=1)), max_size=12), st.data()
)
def test_digests_are_those_of_the_records_whatever_numbers_these_state(
    told: list[tuple[int, int, bytes]], data: st.DataObject
) -> None:
    """Numbers that do not rise, and such that come again: the last one counts."""
    records = [
        FiringRecord("a", incarnation, index, "fire", index, outputs=(Emission(seq, index, digest),))
        for index, (incarnation, seq, digest) in enumerate(sorted(told, key=lambda t: t[0]))
    ]
    log = FiringLog({"a": [encode_batch([record]) for record in records]}, "run.mcap")
    maker = SimpleNamespace(name="a", outputs={"out": "a/out"})
    expected = {(r.incarnation, e.seq): e.digest for r in records for e in r.outputs if e is not None}
    asked = data.draw(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 6)), max_size=12))
    asked = asked if data.draw(st.booleans()) else sorted(asked)

    digests = log.digests([maker], ["a/out"])["a/out"]

    assert [digests.get(place) for place in asked] == [expected.get(place) for place in asked]
    assert list(log.emissions(maker, "a/out")) == sorted(expected.items())


def test_records_of_a_long_run_are_not_in_memory_while_they_are_gone_through() -> None:
    def held() -> int:
        gc.collect()
        return sum(isinstance(o, FiringRecord) for o in gc.get_objects())

    batches = [encode_batch([sent("a", index)]) for index in range(200)]
    log = FiringLog({"a": batches}, "run.mcap")
    maker = SimpleNamespace(name="a", outputs={"out": "a/out"})
    before = held()
    repetition = Repetition(partial(log.ordered, maker), stateless=False)
    look_at([repetition])

    assert repetition.calls == 199
    assert max(held() - before for number, _ in enumerate(repetition) if number % 90 == 0) < 10


def test_records_from_a_place_on_are_decoded_from_near_it(monkeypatch: pytest.MonkeyPatch) -> None:
    count, each = 64, 8
    batches = [encode_batch([record("a", n) for n in range(at, at + each)]) for at in range(0, count * each, each)]
    log, decoded = FiringLog({"a": batches}, "run.mcap"), []
    decode = reading.decode_rows
    monkeypatch.setattr(reading, "decode_rows", lambda batch: decoded.append(batch.first) or decode(batch))

    first = next(iter(log.since(SimpleNamespace(name="a", outputs={}), (0, 300))))

    assert first.index == 300
    assert min(decoded) > 200


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
