"""What an outlet sends to other processes, and when: nothing before its consumers listen, static messages again."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest
from process_doubles import RecordedChannel

from dataflow.messages import FeatureVector
from dataflow.process.streams import outlet
from dataflow.process.streams.outlet import Outlet
from dataflow.sync import Entry
from dataflow.transport import Fanout, Incoming, Kind, Outgoing, PoolReader, decode, make_board, make_ring

INFO, FAST = "test/left/constant", "test/left/fast"


def entry(stream: str, stamp: int, seq: int, incarnation: int = 0) -> Entry:
    message = FeatureVector(stamp=stamp, vectors=np.zeros((1, 1), np.float32), model="test")
    return Entry(stamp, message, seq, incarnation)


class Linked:
    """An outlet with one consumer in another process."""

    def __init__(self, most: tuple[int, int] | None = None) -> None:
        self.descriptors = make_ring(4096), os.eventfd(0, os.EFD_NONBLOCK), make_board()
        link = Outgoing(*self.descriptors, most)
        self.outlet = Outlet(
            RecordedChannel(),
            {},
            fanout=Fanout([([INFO, FAST], link)]),
            namespace="test",
            static=frozenset([INFO]),
            box=None,
            firings=False,
            incarnations={},
            left={},
        )
        self.lives = 0
        self.start()

    def start(self) -> None:
        """The consumer, or what takes its place, begins to listen."""
        self.lives += 1
        self.consumer = Incoming(*self.descriptors, [INFO, FAST], PoolReader(), self.lives)

    def taken(self) -> list[tuple[str, str, int]]:
        found = []
        for _ in range(10_000):
            self.outlet.push()
            arrived = [(key, decode(payload)) for key, payload in self.consumer.take()]
            found += [(key.rpartition("/")[2], e.kind.name, e.seq) for key, e in arrived if e.kind is not Kind.PROBE]
            if not arrived:
                return found
        raise AssertionError("it does not come to an end")


@pytest.fixture
def linked() -> Iterator[Linked]:
    made = Linked()
    yield made
    for descriptor in made.descriptors:
        os.close(descriptor)


def test_nothing_is_sent_before_it_is_released_and_then_all_of_it_once(linked: Linked) -> None:
    linked.outlet.message(INFO, entry(INFO, 0, 0))
    linked.outlet.message(FAST, entry(FAST, 10, 0))
    assert linked.taken() == []
    linked.outlet.release()
    assert linked.taken() == [("constant", "MESSAGE", 0), ("fast", "MESSAGE", 0)]
    assert linked.outlet.sent == 2


def test_restarted_consumer_gets_static_messages_again_and_they_count_as_sent(linked: Linked) -> None:
    linked.outlet.release()
    linked.outlet.message(INFO, entry(INFO, 0, 0))
    linked.outlet.end(INFO, None, "over")
    linked.outlet.message(FAST, entry(FAST, 10, 0))
    first = linked.taken()
    linked.outlet.consumer_gone(0, 1)
    linked.outlet.message(FAST, entry(FAST, 20, 1))  # for nobody
    linked.start()
    assert linked.taken() == [("constant", "MESSAGE", 0), ("constant", "END", 1)]
    linked.outlet.message(FAST, entry(FAST, 30, 2))
    assert linked.taken() == [("fast", "MESSAGE", 2)]
    assert linked.outlet.sent == len(first) + 1 + 3


def test_the_end_of_a_stream_reaches_a_consumer_that_missed_messages() -> None:
    linked = Linked(most=(3, 1 << 20))
    linked.outlet.release()
    for seq in range(200):
        linked.outlet.message(FAST, entry(FAST, seq + 1, seq))
    linked.outlet.end(FAST, 200, "over")
    found = linked.taken()
    assert found[-1] == ("fast", "END", 200)
    assert linked.outlet.counters()["unsent"] == 200 + 1 - len(found)
    assert linked.outlet.counters()["unsent"] > 0


def test_last_drop_of_an_ended_incarnation_is_counted_as_missed(linked: Linked) -> None:
    linked.outlet.release()
    linked.outlet.message(FAST, entry(FAST, 10, 0))
    linked.outlet.message(FAST, entry(FAST, 20, 1))
    linked.outlet.message(FAST, entry(FAST, 5, 0, incarnation=1))  # a clock jumped back
    linked.outlet.message(FAST, entry(FAST, 15, 1, incarnation=1))
    assert linked.taken() == [
        ("fast", "MESSAGE", 0),
        ("fast", "MESSAGE", 1),
        ("fast", "FRONTIER", 2),
        ("fast", "MESSAGE", 0),
        ("fast", "MESSAGE", 1),
    ]


def test_restarted_process_sends_only_message_and_end_on_a_static_stream(linked: Linked) -> None:
    linked.outlet = Outlet(
        RecordedChannel(),
        {},
        fanout=Fanout([([INFO, FAST], Outgoing(*linked.descriptors, None))]),
        namespace="test",
        static=frozenset([INFO]),
        box=None,
        firings=False,
        incarnations={INFO: 2, FAST: 2},
        left={INFO: (1, 1), FAST: (1, 7)},
    )
    linked.outlet.release()
    linked.outlet.message(INFO, entry(INFO, 0, 0))
    linked.outlet.end(INFO, None, "static")
    linked.outlet.message(FAST, entry(FAST, 10, 0, incarnation=2))
    assert linked.taken() == [
        ("fast", "FRONTIER", 7),  # where the process before it had got to
        ("constant", "MESSAGE", 0),
        ("constant", "END", 1),
        ("fast", "MESSAGE", 0),
    ]


def test_unsent_messages_are_reported_when_a_process_leaves(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(outlet, "PUSH_WITHIN", 0.0)
    linked = Linked()
    linked.outlet.release()
    linked.outlet.push_all()
    assert capsys.readouterr().err == ""
    for seq in range(100):  # more than the ring holds, and nobody reads it
        linked.outlet.message(FAST, entry(FAST, 10 * seq, seq))
    linked.outlet.flush_all()
    linked.outlet.push_all()
    assert "what this process sent last is lost" in capsys.readouterr().err
