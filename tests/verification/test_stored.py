"""Stored messages are held against the digests in the firing records, in whatever order they come."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dataflow.verification.stored import StoredCheck, StoredStream

places = st.tuples(st.integers(0, 2), st.integers(0, 9))
digests = st.binary(min_size=1, max_size=1)


def check(recorded: dict[tuple[int, int], bytes], *, static: bool = False, whole: bool = True) -> StoredCheck:
    sent = sorted(d for d in recorded.items() if d[0][1] >= 0)
    return StoredCheck("s/out", "s", lambda: sent, static=static, whole=whole)


@given(st.dictionaries(places, digests), st.lists(st.tuples(places, digests)), st.randoms(), st.booleans())
def test_every_message_is_counted_once_whatever_the_order(recorded, stored, random, whole) -> None:
    first, second = check(recorded, whole=whole), check(recorded, whole=whole)
    shuffled = sorted({place: (place, digest) for place, digest in stored}.values())
    for place, digest in shuffled:
        first.take(place, digest)
    random.shuffle(shuffled)
    for place, digest in shuffled:
        second.take(place, digest)

    found = first.result()

    assert found == second.result()
    known = dict(shuffled)
    changed = sorted(p for p in known.keys() & recorded.keys() if known[p] != recorded[p])
    assert (found.changed, found.first_changed) == (len(changed), changed[0] if changed else None)
    assert found.uncalled == len(known.keys() - recorded.keys())
    missed = recorded.keys() - known.keys()
    assert found.missing == (len(missed) if whole else sum(p > min(known) for p in missed) if known else 0)
    assert StoredStream.from_wire(found.to_wire()) == found


def test_a_message_that_is_stored_twice_is_one_too_many() -> None:
    one = check({(0, 0): b"a"})
    for _ in range(2):
        one.take((0, 0), b"a")

    assert (one.result().uncalled, one.result().changed) == (1, 0)
    assert not one.result().as_recorded


def test_messages_that_were_withheld_or_lie_before_the_start_are_not_missed() -> None:
    late = check({(0, 0): b"a", (0, 1): b"b", (0, 2): b"c", (0, -1): b"w"}, whole=False)
    late.take((0, 1), b"b")

    assert (late.result().missing, late.result().first_missing) == (1, (0, 2))


def test_a_static_stream_is_stored_once_however_often_it_was_made() -> None:
    one = check({(0, 0): b"a", (1, 0): b"a"}, static=True)
    one.take((0, 0), b"a")

    assert one.result().missing == 0
    assert check({(0, 0): b"a"}, static=True).result().missing == 1


def test_messages_before_the_start_are_not_held() -> None:
    late = check({(0, seq): b"a" for seq in range(1000)}, whole=False)
    late.take((0, 990), b"a")

    assert not late._passed
    assert late.result().missing == 9
