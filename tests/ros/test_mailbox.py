"""What arrives is bounded, and what does not fit is counted."""

from __future__ import annotations

import pytest

from dataflow.ros import mailbox
from dataflow.ros.mailbox import Arrival, Mailbox, TokenChange


def test_it_gives_what_came_in_order_and_ends_when_it_is_closed() -> None:
    box = Mailbox()
    box.sample(b"a", b"1")
    box.token("@ros2_lv", True)
    first = box.get(1.0)
    assert isinstance(first, Arrival)
    assert first[:2] == (b"a", b"1")
    assert box.get(1.0) == TokenChange("@ros2_lv", True)
    assert box.get(0.0) is None
    box.close()
    assert box.get(None) is None
    assert box.closed


def test_what_does_not_fit_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
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
