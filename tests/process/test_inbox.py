"""An inbox gives what its threads put there and what its rings bring, and wakes who waits for either."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Iterator

import pytest

from dataflow.process.streams.inbox import Inbox
from dataflow.supervision.process_main import await_leave
from dataflow.transport import Incoming, Outgoing, PoolReader, make_board, make_ring

LONG = 60.0
"""Seconds that a test would take if nobody woke the one who waits."""


class Wired:
    """An inbox with one link to it."""

    def __init__(self) -> None:
        self.ring, self.board = make_ring(4096), make_board()
        self.wake, self.back = (os.eventfd(0, os.EFD_NONBLOCK) for _ in range(2))
        incoming = Incoming(self.ring, self.back, self.board, ["a", "b"], PoolReader(), 1)
        self.inbox = Inbox(self.wake, [incoming])
        self.producer = Outgoing(self.ring, self.wake, self.board, None)

    def send(self, content: bytes, channel: int = 0) -> None:
        self.producer.send(channel, [content], len(content))

    def close(self) -> None:
        for descriptor in (self.ring, self.board, self.wake, self.back):
            os.close(descriptor)


@pytest.fixture
def wired() -> Iterator[Wired]:
    made = Wired()
    yield made
    made.close()


def test_inbox_orders_ring_messages_and_thread_puts(wired: Wired) -> None:
    wired.inbox.put(("control", "go", {}))
    wired.send(b"1")
    wired.send(b"2", channel=1)
    assert not wired.inbox.empty()
    wired.inbox.put(("control", "stop", {}))
    found = [wired.inbox.get_nowait() for _ in range(4)]
    assert found == [("control", "go", {}), ("envelope", "a", b"1"), ("envelope", "b", b"2"), ("control", "stop", {})]
    assert wired.inbox.empty()
    with pytest.raises(queue.Empty):
        wired.inbox.get_nowait()


def test_an_empty_inbox_is_waited_for_no_longer_than_asked(wired: Wired) -> None:
    with pytest.raises(queue.Empty):
        wired.inbox.get(timeout=0.001)


@pytest.mark.parametrize("through", ["ring", "thread"])
def test_waiting_thread_is_woken_by_arrivals(wired: Wired, through: str) -> None:
    act = (lambda: wired.send(b"x")) if through == "ring" else (lambda: wired.inbox.put(("control", "go", {})))
    timer = threading.Timer(0.02, act)
    timer.start()
    assert wired.inbox.get(timeout=LONG)[0] in ("envelope", "control")
    timer.join()


def test_waiting_writer_is_woken_when_a_full_ring_has_room(wired: Wired) -> None:
    sender = Inbox(wired.back)
    while not wired.producer.waiting:
        wired.send(bytes(900))
    timer = threading.Timer(0.02, lambda: wired.inbox.get_nowait())
    timer.start()
    with pytest.raises(queue.Empty):
        sender.get(timeout=LONG)
    timer.join()
    assert wired.producer.flush()


def test_received_messages_are_counted(wired: Wired) -> None:
    wired.send(b"four")
    wired.send(b"two")
    assert wired.inbox.empty() is False
    assert wired.inbox.counters() == {"received_messages": 2, "received_bytes": 7, "unresolved": 0}


def test_a_failed_process_waits_for_the_supervisor_whatever_else_wakes_it() -> None:
    class Woken:
        """An inbox that is woken twice for nothing."""

        def __init__(self) -> None:
            self.items: list[object] = [None, None, ("control", "leave", {"outcome": "failed", "again": True})]

        def get(self, timeout: float) -> object:
            if (item := self.items.pop(0)) is None:
                raise queue.Empty
            return item

    assert await_leave(Woken())


def test_the_turn_is_another_threads_only_while_the_one_that_has_it_waits_for_nothing(wired: Wired) -> None:
    waiting, done = threading.Event(), threading.Event()
    inbox = wired.inbox
    assert not inbox.take_turn()  # this thread has it
    found = []

    def act() -> None:
        waiting.wait(LONG)
        while not inbox.take_turn():
            if done.is_set():
                return
        found.append(inbox.empty())
        inbox.give_turn(wake=False)
        inbox.put(("control", "go", {}))

    thread = threading.Thread(target=act)
    thread.start()
    waiting.set()
    assert inbox.get(timeout=LONG) == ("control", "go", {})
    done.set()
    thread.join()
    assert found == [True]
    assert not inbox.take_turn()


def test_the_thread_that_waits_is_woken_for_what_another_has_left_it(wired: Wired) -> None:
    def act() -> None:
        while not wired.inbox.take_turn():
            pass
        wired.inbox.give_turn(wake=True)

    thread = threading.Thread(target=act)
    thread.start()
    with pytest.raises(queue.Empty):
        wired.inbox.get(timeout=LONG)
    thread.join()


def test_one_wakeup_wakes_the_waiting_thread_once(wired: Wired) -> None:
    os.eventfd_write(wired.wake, 1)
    with pytest.raises(queue.Empty):
        wired.inbox.get(timeout=LONG)

    timer = threading.Timer(0.02, lambda: wired.inbox.put(("control", "go", {})))
    timer.start()
    assert wired.inbox.get(timeout=LONG) == ("control", "go", {})
    timer.join()
