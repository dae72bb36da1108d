"""A batch of one record is the same bytes whichever way it was made."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dataflow.records.firing import Emission, FiringRecord, decode_batch, encode_batch, encode_single
from dataflow.sync import Drop, MessageRef, RunRef

STAMPS = st.integers(-(2**62), 2**62)
NUMBERS = st.integers(0, 2**40)
STREAMS = st.sampled_from(["n/left/image", "n/right/image", "n/imu/out"])
MESSAGES = st.builds(MessageRef, STREAMS, st.integers(0, 3), NUMBERS)
INPUTS = st.dictionaries(
    st.sampled_from(["left", "right", "imu"]),
    MESSAGES | st.none() | st.tuples(st.builds(RunRef, STREAMS, st.integers(0, 3), NUMBERS, NUMBERS)),
)
EMISSIONS = st.none() | st.builds(Emission, st.integers(-1, 2**40), STAMPS, st.binary(min_size=16, max_size=16))
DROPS = st.builds(Drop, st.just("left"), STREAMS, STAMPS, NUMBERS, st.integers(0, 3), st.just("unmatched"))
RECORDS = st.builds(
    FiringRecord,
    operator=st.sampled_from(["fuse", "track"]),
    incarnation=st.integers(0, 300),
    index=NUMBERS,
    kind=st.sampled_from(["fire", "tick", "finish", "setup"]),
    stamp=STAMPS,
    tick=st.booleans(),
    inputs=INPUTS | st.dictionaries(st.sampled_from(["left", "right", "imu"]), MESSAGES),
    stale=st.just(frozenset()) | st.just(frozenset(["imu"])),
    late=st.just(frozenset()) | st.just(frozenset(["imu"])),
    outputs=st.lists(EMISSIONS, max_size=3).map(tuple),
    outcome=st.sampled_from(["ok", "error"]),
    drops=st.just(()) | st.lists(DROPS, max_size=2).map(tuple),
    detail=st.just({}) | st.just({"error": "ValueError: no"}),
    wall_start=NUMBERS,
    duration=NUMBERS,
)


@given(st.lists(RECORDS, min_size=1, max_size=5))
def test_a_batch_of_one_record_is_made_as_any_other(records: list[FiringRecord]) -> None:
    for record in records:
        data = encode_single(record)
        assert data == encode_batch([record])
        assert decode_batch(data).records == (record,)
