"""Which envelopes of a stream count: its own, whatever else is on its key and whatever was lost on the way."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given
from hypothesis import strategies as st
from process_doubles import STREAM, end, frontier, message

from dataflow.process.stream_order import StreamOrder, Verdict
from dataflow.sync import FOREVER
from dataflow.transport import Envelope, Kind


def stream_of(count: int) -> list[Envelope]:
    """A whole stream as a publisher sends it: each message and the frontier after it, then the end."""
    own: list[Envelope] = []
    for seq in range(count):
        own += [message(seq), frontier(seq + 1, 1005 + 10 * seq)]
    return [*own, frontier(count, 5000), end(count, 5000)]


def take_all(order: StreamOrder, envelopes: Sequence[Envelope]) -> Verdict:
    """What follows from several envelopes together; at most one gap."""
    verdicts = [order.take(envelope) for envelope in envelopes]
    gaps = [verdict.gap for verdict in verdicts if verdict.gap is not None]
    assert len(gaps) <= 1
    taken = [envelope for verdict in verdicts for envelope in verdict.taken]
    return Verdict(taken, gaps[0] if gaps else None, sum(verdict.refused for verdict in verdicts))


def envelope_of(kind: Kind, incarnation: int, seq: int, stamp: int) -> Envelope:
    if kind is Kind.MESSAGE:
        return message(seq, min(stamp, FOREVER - 1), incarnation)
    return Envelope(kind, STREAM, incarnation, seq, stamp)


foreign = st.builds(
    envelope_of,
    st.sampled_from([Kind.MESSAGE, Kind.FRONTIER, Kind.END]),
    st.integers(0, 3),
    st.integers(0, 12) | st.just(10**6),
    st.integers(0, 10_000) | st.sampled_from([FOREVER - 1, FOREVER]),
)


@given(st.integers(1, 6).map(stream_of), st.data())
def test_a_stream_is_taken_whole_whatever_single_envelopes_of_others_are_among_it(
    own: list[Envelope], data: st.DataObject
) -> None:
    """Anywhere after the first message, at any place but the one that is due."""
    mixed, strange = [own[0]], 0
    for envelope in own[1:]:
        other = data.draw(st.none() | foreign)
        if other is not None and (other.incarnation, other.seq) != (envelope.incarnation, envelope.seq):
            mixed.append(other)
            strange += 1
        mixed.append(envelope)

    verdict = take_all(StreamOrder(), mixed)

    assert list(verdict.taken) == own
    assert (verdict.gap, verdict.refused) == (None, strange)


@given(st.integers(3, 8), st.data())
def test_what_was_lost_is_said_once_and_the_rest_is_taken(count: int, data: st.DataObject) -> None:
    own = stream_of(count)
    first = data.draw(st.integers(1, len(own) - 3))
    following = data.draw(st.integers(first, len(own) - 3))
    arrived = [*own[:first], *own[following:]]

    verdict = take_all(StreamOrder(), arrived)

    assert list(verdict.taken) == arrived
    lost = [e.seq for e in own[first:following] if e.kind is Kind.MESSAGE]
    assert verdict.gap == ((lost[0], lost[-1] + 1) if lost else None)
    assert verdict.refused == 0


def test_a_taker_that_comes_late_begins_with_the_first_message_it_sees() -> None:
    late = [frontier(57, 900), message(57), message(58)]

    assert list(take_all(StreamOrder(), late).taken) == late


def test_a_restart_that_was_announced_is_believed_at_once() -> None:
    order = StreamOrder()
    take_all(order, [message(0), message(1)])
    order.announce()

    assert order.take(frontier(0, 1500, incarnation=1)).taken
    assert order.take(message(0, 2000, incarnation=1)).taken
    assert order.take(message(2)).refused == 1  # of the process that died
    assert order.take(message(1, 2010, incarnation=1)).taken


def test_an_announced_restart_says_which_of_its_messages_were_lost() -> None:
    order = StreamOrder()
    take_all(order, [message(0), message(1)])
    order.announce()

    assert order.take(message(3, 2000, incarnation=1)).gap == (0, 3)


def test_a_new_incarnation_without_a_restart_is_believed_when_it_goes_on() -> None:
    """A clock that jumped back, or an operator that was made anew in its process."""
    order = StreamOrder()
    take_all(order, [message(0), message(1)])
    begun = message(0, 500, incarnation=1)

    assert not order.take(begun).taken
    assert list(order.take(frontier(1, 500, incarnation=1)).taken) == [begun, frontier(1, 500, incarnation=1)]


def test_one_message_of_a_forged_incarnation_changes_nothing() -> None:
    verdict = take_all(StreamOrder(), [message(0), message(0, incarnation=99), message(1)])

    assert list(verdict.taken) == [message(0), message(1)]
    assert verdict.refused == 1


def test_a_stream_outlives_a_message_that_took_the_place_of_its_own() -> None:
    """Nothing tells the forged one apart, but the stream goes on when its own stamps are past it."""
    order = StreamOrder()
    verdict = take_all(order, [message(0), message(1, 1035), message(1), message(2), message(3), message(4)])

    assert [(e.seq, e.stamp) for e in verdict.taken] == [(0, 1000), (1, 1035), (4, 1040)]
    assert verdict.refused == 3


def test_an_end_after_a_jump_back_is_no_earlier_than_what_was_promised() -> None:
    order = StreamOrder()
    taken = take_all(order, [message(0), message(1), frontier(2, 700), end(2, 700)]).taken

    assert taken[-1] == end(2, 1010)
    assert order.take(message(2)).damaged


def taken_by(envelopes: list[Envelope], *, shortcut: bool) -> list[object]:
    """What becomes of envelopes in turn, with or without the short way for those that simply go on."""
    order, found = StreamOrder(), []
    for envelope in envelopes:
        if shortcut and order.goes_on(envelope):
            found.append(Verdict([envelope]))
        else:
            found.append(order.take(envelope))
    return found


KINDS = st.sampled_from([Kind.MESSAGE, Kind.MESSAGE, Kind.MESSAGE, Kind.FRONTIER, Kind.END])


@given(st.lists(st.tuples(KINDS, st.integers(0, 1), st.integers(0, 5), st.integers(0, 12)), max_size=14))
def test_the_short_way_for_what_simply_goes_on_decides_as_the_long_one(
    places: list[tuple[Kind, int, int, int]],
) -> None:
    envelopes = [Envelope(kind, "a/b/c", incarnation, seq, stamp) for kind, incarnation, seq, stamp in places]
    assert taken_by(envelopes, shortcut=True) == taken_by(envelopes, shortcut=False)


def test_messages_that_follow_each_other_take_the_short_way() -> None:
    order = StreamOrder()
    order.take(Envelope(Kind.MESSAGE, "a/b/c", 0, 0, 10))
    assert all(order.goes_on(Envelope(Kind.MESSAGE, "a/b/c", 0, seq, 10 + seq)) for seq in range(1, 5))
