"""What arrives is bounded, and what does not fit is counted."""

from __future__ import annotations

import pytest

from dataflow.ros import mailbox
from dataflow.ros.mailbox import Arrival, Mailbox, TokenChange
from dataflow.ros.wire import Attachment


def sent(number: int) -> Attachment:
    return Attachment(number, 1000 * number, b"a" * 16)


def test_mailbox_returns_arrivals_in_order_and_ends_when_closed() -> None:
    box = Mailbox()
    box.clock = 7
    box.sample(b"a", sent(1).encoded())
    box.token("@ros2_lv", True)
    first = box.get(1.0)
    assert isinstance(first, Arrival)
    assert first[:5] == (b"a", sent(1), 0, 0, 7)
    assert box.get(1.0) == TokenChange("@ros2_lv", True)
    assert box.get(0.0) is None
    box.close()
    assert box.get(None) is None
    assert box.closed


def test_mailbox_overflow_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mailbox, "MOST_BYTES", 10)
    box = Mailbox()
    for size in (6, 5, 4):
        box.sample(bytes(size), b"")
    assert box.overflow == 1
    came = [box.get(0.0), box.get(0.0), box.get(0.0)]
    assert [len(each.data) for each in came if isinstance(each, Arrival)] == [6, 4]
    box.sample(bytes(10), b"")
    assert box.overflow == 1
    monkeypatch.setattr(mailbox, "MOST", 1)
    box.sample(b"", b"")
    assert box.overflow == 2


def test_mailbox_overflow_is_not_counted_as_ros_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mailbox, "MOST", 2)
    box = Mailbox()
    for number in (1, 2, 3, 4):
        box.sample(b"", sent(number).encoded())
    came = [box.get(0.0), box.get(0.0)]
    for number in (5, 8):
        box.sample(b"", sent(number).encoded())
    came += [box.get(0.0), box.get(0.0)]
    found = [(c.seen.number, c.missing, c.lost) for c in came if isinstance(c, Arrival) and c.seen]
    assert found == [(1, 0, 0), (2, 0, 0), (5, 0, 0), (8, 2, 2)]
    assert (box.overflow, box.losses.lost) == (2, 2)


def test_changes_of_tokens_are_bounded_and_take_no_room_of_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mailbox, "MOST", 2)
    box = Mailbox()
    for number in range(5):
        box.token(f"@ros2_lv/{number}", True)
    box.sample(b"", b"")
    assert (box.unnamed, box.overflow) == (3, 0)
    assert [type(box.get(0.0)) for _ in range(4)] == [TokenChange, TokenChange, Arrival, type(None)]
    box.token("@ros2_lv/9", True)
    assert box.unnamed == 3
