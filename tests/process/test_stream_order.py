"""Which envelopes of a stream count: those that go on from what it has said, whatever was lost on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st
from process_doubles import end, frontier, message

from dataflow.process.streams.stream_order import StreamOrder, Verdict
from dataflow.sync import FOREVER, NEVER
from dataflow.transport import Envelope, Kind


def stream_of(count: int) -> list[Envelope]:
    """A whole stream as a publisher sends it: each message and the frontier after it, then the end."""
    own: list[Envelope] = []
    for seq in range(count):
        own += [message(seq), frontier(seq + 1, 1005 + 10 * seq)]
    return [*own, end(count, 5000)]


def take_all(order: StreamOrder, envelopes: Sequence[Envelope]) -> tuple[list[Envelope], list[tuple[int, int]]]:
    """What is taken of several envelopes, and the gaps."""
    verdicts = [order.take(envelope) for envelope in envelopes]
    taken = [verdict.taken for verdict in verdicts if verdict.taken is not None]
    return taken, [verdict.gap for verdict in verdicts if verdict.gap is not None]


@given(st.integers(3, 8), st.data())
def test_gap_is_reported_once_and_the_rest_is_taken(count: int, data: st.DataObject) -> None:
    own = stream_of(count)
    first = data.draw(st.integers(1, len(own) - 2))
    following = data.draw(st.integers(first, len(own) - 1))
    arrived = [*own[:first], *own[following:]]

    taken, gaps = take_all(StreamOrder(), arrived)

    assert taken == arrived
    lost = [e.seq for e in own[first:following] if e.kind is Kind.MESSAGE]
    assert gaps == ([(lost[0], lost[-1] + 1)] if lost else [])


@given(st.integers(1, 6).map(stream_of), st.data())
def test_contradicting_envelopes_change_nothing(own: list[Envelope], data: st.DataObject) -> None:
    """Places that are past, and the end of time."""
    order = StreamOrder()
    taken: list[Envelope] = []
    for envelope in own:
        taken += take_all(order, [envelope])[0]
        behind = envelope.seq - (0 if envelope.kind is Kind.MESSAGE else 1)
        strange = [message(seq, 10**6) for seq in range(behind + 1)] + [frontier(0, 3), frontier(envelope.seq, FOREVER)]
        for other in data.draw(st.lists(st.sampled_from(strange), max_size=3)):
            assert order.take(other).taken is None
    assert taken == own


def test_a_taker_that_comes_late_begins_with_the_first_message_it_sees() -> None:
    late = [frontier(57, 900), message(57), message(58)]

    assert take_all(StreamOrder(), late) == (late, [])


def test_a_new_incarnation_is_believed_at_once_and_the_one_before_is_over() -> None:
    """A restart, a clock that jumped back, or an operator that was made anew in its process."""
    order = StreamOrder()
    take_all(order, [message(0), message(1)])

    assert order.take(frontier(0, 1500, incarnation=1)).taken
    assert order.take(message(0, 500, incarnation=1)).taken
    assert order.take(message(2)).damaged == "went back to incarnation 0"
    assert order.take(message(1, 510, incarnation=1)).taken


def test_initial_gap_of_a_new_incarnation_is_reported_once() -> None:
    order = StreamOrder()
    take_all(order, [message(0), message(1)])

    later = [frontier(3, 2000, incarnation=1), message(3, 2001, incarnation=1), message(4, 2002, incarnation=1)]
    assert take_all(order, later) == (later, [(0, 3)])


def test_frontier_from_a_successor_reveals_messages_lost_of_its_predecessor() -> None:
    said_by_successor = frontier(4, NEVER)

    order = StreamOrder((0, 0))
    take_all(order, [message(0), message(1)])
    assert order.take(said_by_successor) == Verdict(gap=(2, 4), repeats=True)
    assert take_all(order, [message(0, 2000, incarnation=1)])[1] == []

    whole = StreamOrder((0, 0))
    take_all(whole, stream_of(4))  # and it has ended
    assert whole.take(said_by_successor) == Verdict(repeats=True)


def test_a_successor_with_nothing_more_to_say_ends_the_stream_again_as_it_ended() -> None:
    order = StreamOrder((0, 0))
    *_, over = take_all(order, stream_of(4))[0]

    assert order.take(end(4, 9000)) == Verdict()
    assert order.take(frontier(0, 9000, incarnation=1)) == Verdict(repeats=True)
    ends = [order.take(end(0, NEVER, incarnation)).taken for incarnation in (1, 2)]
    assert ends == [replace(over, incarnation=incarnation) for incarnation in (1, 2)]
    assert order.take(end(0, NEVER, incarnation=1)) == Verdict()
    assert order.take(message(0, 9000, incarnation=2)).taken
    assert order.take(end(1, 9000, incarnation=2)).taken == end(1, 9000, incarnation=2)


def test_an_end_after_a_jump_back_is_no_earlier_than_what_was_promised() -> None:
    order = StreamOrder()
    taken, _ = take_all(order, [message(0), message(1), frontier(2, 700), end(2, 700)])

    assert taken[-1] == end(2, 1010)
    assert order.take(message(2)) == Verdict()


def test_a_message_that_breaks_a_promise_is_damage() -> None:
    order = StreamOrder()
    take_all(order, [message(0), frontier(1, 1500)])

    assert order.take(message(1, 1400)).damaged == "broke its promise with number 1, stamp 1400"
    assert order.take(message(2, 1600)).taken


def taken_by(envelopes: list[Envelope], *, shortcut: bool) -> list[Verdict]:
    """What becomes of envelopes in turn, with or without the short way for those that simply go on."""
    order = StreamOrder()
    found: list[Verdict] = []
    for envelope in envelopes:
        if shortcut and order.goes_on(envelope):
            found.append(Verdict(envelope))
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
