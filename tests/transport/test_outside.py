"""Subscribers from outside get what is published in order; who is slow holds nobody up where messages may be lost."""

from __future__ import annotations

import threading

from dataflow.transport import Counters, OutsidePublisher
from dataflow.transport.outside import MOST_MESSAGES

WAIT = 30.0


class Subscriber:
    """Stands for a stream's publisher: it waits, as for a subscriber that takes nothing, until it is let go."""

    stream = "test/left/fast"

    def __init__(self) -> None:
        self.took: list[int] = []
        self.entered, self.let_go = threading.Event(), threading.Event()

    def put(self, payload: bytes) -> None:
        self.entered.set()
        self.let_go.wait(WAIT)
        self.took.append(int.from_bytes(payload, "little"))


def publishes(outside: OutsidePublisher, subscriber: Subscriber, numbers: range) -> None:
    for number in numbers:
        outside.put(subscriber, number.to_bytes(4, "little"))


def test_everything_is_published_in_order_before_it_is_closed() -> None:
    subscriber, outside = Subscriber(), OutsidePublisher(Counters(), lossless=False)
    subscriber.let_go.set()
    publishes(outside, subscriber, range(1000))
    outside.close()
    outside.close()
    assert subscriber.took == list(range(1000))


def test_queue_of_a_slow_subscriber_is_bounded_and_drops_the_oldest() -> None:
    counted = Counters()
    subscriber, outside = Subscriber(), OutsidePublisher(counted, lossless=False)
    publishes(outside, subscriber, range(1))
    assert subscriber.entered.wait(WAIT)
    publishes(outside, subscriber, range(1, MOST_MESSAGES + 101))
    subscriber.let_go.set()
    outside.close()
    assert subscriber.took == [0, *range(101, MOST_MESSAGES + 101)]
    assert counted.as_dict()["unpublished"] == 100


def test_a_run_that_loses_nothing_waits_for_a_slow_subscriber() -> None:
    counted = Counters()
    subscriber, outside = Subscriber(), OutsidePublisher(counted, lossless=True)
    publishing = threading.Thread(target=publishes, args=(outside, subscriber, range(MOST_MESSAGES + 100)))
    publishing.start()
    assert subscriber.entered.wait(WAIT)
    subscriber.let_go.set()
    publishing.join(WAIT)
    outside.close()
    assert subscriber.took == list(range(MOST_MESSAGES + 100))
    assert counted.as_dict()["unpublished"] == 0


def test_closing_does_not_wait_for_a_subscriber_that_takes_nothing(monkeypatch) -> None:
    monkeypatch.setattr("dataflow.transport.outside.CLOSE_WITHIN", 0.01)
    subscriber, outside = Subscriber(), OutsidePublisher(Counters(), lossless=False)
    publishes(outside, subscriber, range(3))
    assert subscriber.entered.wait(WAIT)
    outside.close()
    assert subscriber.took == []
    subscriber.let_go.set()
