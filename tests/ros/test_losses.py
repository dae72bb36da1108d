"""What a publisher sent and what never came, by numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.ros import losses as module
from dataflow.ros.losses import Losses
from dataflow.ros.wire import Attachment

GID, OTHER = b"a" * 16, b"b" * 16


def sent(number: int, gid: bytes = GID, start: int = 0) -> Attachment:
    return Attachment(number, start + 1000 * number, gid)


def test_a_gap_is_counted_when_the_message_after_it_comes() -> None:
    losses = Losses()
    assert [losses.take(sent(n)) for n in (5, 6, 9, 10, 12)] == [0, 0, 2, 0, 1]
    assert losses.lost == 3


def test_publishers_are_counted_apart_and_a_restart_is_a_new_one() -> None:
    losses = Losses()
    for gid in (GID, OTHER):
        losses.take(sent(100, gid))
    assert losses.take(sent(1, b"c" * 16)) == 0
    assert losses.take(sent(102, OTHER)) == 1
    assert losses.publishers[GID].lost == 0
    assert losses.publishers[OTHER].lost == losses.lost == 1


def test_publisher_restarted_with_its_gid_has_lost_nothing() -> None:
    losses = Losses()
    losses.take(sent(50))
    assert [losses.take(sent(n, start=10**9)) for n in (1, 2, 4)] == [0, 0, 1]
    assert losses.lost == 1


def test_a_clock_that_is_set_back_or_stands_still_changes_no_count() -> None:
    losses = Losses()
    for number in range(1, 101):
        losses.take(sent(number, start=10**9))
    for number in range(101, 201):
        losses.take(sent(number))
    assert losses.take(Attachment(201, sent(200).time, GID)) == 0
    assert losses.take(Attachment(204, sent(200).time, GID)) == 2
    assert (losses.lost, losses.publishers[GID].received) == (2, 202)


def test_publishers_are_forgotten_when_there_are_too_many_and_their_losses_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MOST_KNOWN", 3)
    losses = Losses()
    for number in (1, 3):
        losses.take(sent(number))
    for other in range(5):
        losses.take(sent(1, bytes([other]) * 16))
        losses.take(sent(2 + other, OTHER))
    assert len(losses.publishers) == 3
    assert OTHER in losses.publishers
    assert GID not in losses.publishers
    assert losses.lost == 1


@given(st.data())
def test_lost_messages_are_counted_despite_late_and_repeated_ones(data: st.DataObject) -> None:
    numbers = data.draw(st.sets(st.integers(2, 40)))
    order = data.draw(st.permutations([*numbers, *data.draw(st.lists(st.sampled_from(sorted(numbers or {1}))))]))
    losses = Losses()
    losses.take(sent(1))
    for number in order:
        losses.take(sent(number))
    came = {1, *numbers}
    assert losses.lost == max(came) - len(came)
    assert losses.publishers[GID].received == len(came)
