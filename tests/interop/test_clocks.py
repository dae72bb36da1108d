"""The clock of a bag, and stamps that repeat or go back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.interop.clocks import Times, choose_clock, repair

S = 1_000_000_000
LOG = np.arange(10) * S // 10 + 1_700_000_000 * S


def times(header: object, topic: str = "/a", log: np.ndarray = LOG, **more: bool) -> Times:
    return Times(topic, log, None if header is None else np.asarray(header), **more)


def test_headers_are_taken_where_they_can_be() -> None:
    clock = choose_clock([times(LOG - 5_000_000)])

    assert (clock.kind, clock.shift) == ("header", 0)
    assert clock.stamps(times(LOG - 5_000_000)).tolist() == (LOG - 5_000_000).tolist()


def test_messages_without_a_header_are_moved_to_the_clock_of_the_headers() -> None:
    simulated = np.arange(10) * S // 10 + 7 * S
    clock = choose_clock([times(simulated), times(None, "/text")])

    assert clock.kind == "header"
    assert clock.stamps(times(None, "/text")).tolist() == simulated.tolist()
    assert "behind the recorder's clock" in clock.why


def test_headers_that_carry_no_time_are_not_taken() -> None:
    assert choose_clock([times(np.zeros(10, np.int64))]).why == "10 of 10 headers of /a carry no time"


def test_headers_of_different_clocks_are_not_taken() -> None:
    clock = choose_clock([times(LOG), times(LOG - 3 * S, "/b")])

    assert clock.kind == "log"
    assert clock.why == "the headers of /b and /a are of different clocks, 3.000 s apart"


def test_headers_that_go_far_back_are_not_taken() -> None:
    assert choose_clock([times([*LOG[:5], *(LOG[:5] - 60 * S)])]).why == "the headers of /a go back by 60.4 s"


def test_headers_of_a_clock_set_ahead_are_refused() -> None:
    log = np.arange(60) * S // 10 + 1_700_000_000 * S
    month = 30 * 86_400 * S
    leaping = np.concatenate([log[:30] - month, log[30:]])
    paused = np.concatenate([log[:30], log[30:] + 60 * S])

    assert choose_clock([times(leaping, log=log)]).why == "the headers of /a leap ahead of the log by 2,592,000.0 s"
    assert choose_clock([times(np.where(np.arange(60) == 30, log + 4 * S, log), log=log)]).kind == "header"
    assert choose_clock([times(paused, log=paused)]).kind == "header"
    assert choose_clock([times(paused, log=np.full(60, log[0]))]).kind == "header"
    assert choose_clock([times(log[0] + np.arange(60) * S, log=log)]).kind == "header"  # ten times as fast


def test_headers_of_a_clock_set_back_are_refused_and_late_messages_sorted() -> None:
    log = np.arange(60) * S // 10 + 1_700_000_000 * S
    late = log.copy()
    late[[30, 31]] = late[[28, 27]] - 500_000_000

    assert choose_clock([times([*log[:30], *(log[30:] - 2 * S)], log=log)]).why == "the headers of /a go back by 1.9 s"
    assert choose_clock([times(late, log=log)]).kind == "header"


def test_headers_that_stand_still_are_not_taken() -> None:
    assert choose_clock([times([LOG[0]] * 10)]).why == "10 headers of /a carry only 1 different times"
    assert choose_clock([times([LOG[0]] * 10, shares=True)]).kind == "header"


def test_latched_topics_do_not_choose_the_clock_and_are_stamped_on_arrival() -> None:
    old = times(LOG[:1] - 3600 * S, "/tf_static", LOG[:1], latched=True)
    clock = choose_clock([times(LOG), old])

    assert clock.kind == "header"
    assert clock.stamps(old).tolist() == LOG[:1].tolist()


def test_requested_clock_is_chosen() -> None:
    assert choose_clock([times(LOG - S // 5)], "log").stamps(times(LOG - S // 5)).tolist() == LOG.tolist()
    assert choose_clock([times(np.zeros(10, np.int64))], "header").kind == "header"


def test_repair_orders_leaves_out_and_moves() -> None:
    found = repair(np.array([10, 30, 20, 20, 20]), np.array([1, 2, 3, 3, 4], np.uint64))

    assert found.order.tolist() == [0, 2, 4, 1]
    assert found.stamps.tolist() == [10, 20, 21, 30]
    assert found.facts() == {"reordered": 3, "repeated": 1, "moved": 1}


def test_moved_stamps_never_run_into_the_next() -> None:
    found = repair(np.array([5, 5, 5, 6]), np.array([1, 2, 3, 4], np.uint64))

    assert found.stamps.tolist() == [5, 6, 7, 8]


def test_merged_messages_share_a_stamp() -> None:
    found = repair(np.array([5, 5, 6]), np.array([1, 2, 3], np.uint64), merge=True)

    assert found.stamps.tolist() == [5, 5, 6]
    assert found.facts() == {"merged": 1}


@given(st.lists(st.tuples(st.integers(-3, 12), st.integers(0, 3)), max_size=30))
def test_repaired_stamps_strictly_increase_and_nothing_else_is_lost(rows: list[tuple[int, int]]) -> None:
    stamps = np.array([s for s, _ in rows], np.int64)
    digests = np.array([d for _, d in rows], np.uint64)

    found = repair(stamps, digests)

    assert (np.diff(found.stamps) > 0).all()
    assert (found.stamps >= stamps[found.order]).all()
    kept = {(int(stamps[i]), int(digests[i])) for i in found.order}
    assert kept == {(s, d) for s, d in rows if s >= 0}
    assert len(found.order) + found.repeated + found.before_epoch == len(rows)


@pytest.mark.parametrize(
    ("each", "words"), [(S // 10_000, "1,000 times as slowly as"), (100_000 * S, "1,000,000 times")]
)
def test_headers_of_another_unit_are_noted(each: int, words: str) -> None:
    log = LOG[0] + np.arange(20) * S // 10

    (note,) = choose_clock([times(LOG[0] + np.arange(20) * each, log=log)]).notes

    assert words in note
    assert "in another unit? --clock log" in note


@pytest.mark.parametrize("pace", [0.01, 1.0, 20.0])
def test_a_simulation_that_is_slow_or_fast_is_not_noted(pace: float) -> None:
    log = LOG[0] + np.arange(20) * S // 10

    assert not choose_clock([times(7 * S + (np.arange(20) * S // 10 * pace).astype(np.int64), log=log)]).notes


def test_one_publisher_of_transforms_without_times_does_not_take_those_of_others() -> None:
    mixed = np.where(np.arange(10) % 2, 0, LOG)

    chosen = choose_clock([times(mixed, shares=True)])

    assert chosen.kind == "header"
    assert "5 of 10 headers carry no time" in chosen.notes[0]
    assert choose_clock([times(mixed)]).kind == "log"
