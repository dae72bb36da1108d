"""What processes say, print and leave becomes events, in order; orders reach them. The processes are played here."""

from __future__ import annotations

import os
import selectors
from collections.abc import Iterator
from typing import Any

import pytest

from dataflow.process.channel import Channel, QueuedChannel
from dataflow.supervision.children import NOT_READING_AFTER, Children
from dataflow.supervision.core.events import (
    Aborted,
    Disconnected,
    Event,
    Exited,
    NotReading,
    OrphansKilled,
    Printed,
    Received,
)
from dataflow.supervision.nursery import Child, ChildExited, NurseryFailed, Orphans


class PlayedNursery:
    """Gives processes that the test plays: their ends of the channel and of the pipe that they print into."""

    def __init__(self) -> None:
        self.ends: list[tuple[Channel, int]] = []
        self.news: list[ChildExited | Orphans] = []
        self.failure: NurseryFailed | None = None
        self.closed = False
        self._reading, self._writing = os.pipe()

    def fileno(self) -> int:
        return self._reading

    def spawn(self, handed: tuple[int, ...]) -> Child:
        if self.failure is not None:
            raise self.failure
        channel = QueuedChannel(most=1 << 20)
        reading, writing = os.pipe()
        self.ends.append((Channel(channel.theirs), writing))
        return Child(channel, reading)

    def receive(self) -> list[ChildExited | Orphans]:
        if self.failure is not None:
            raise self.failure
        return self.news

    def close(self) -> None:
        self.closed = True
        for descriptor in (self._reading, self._writing):
            os.close(descriptor)


class Scene:
    """Two processes, `a` and `b`, a clock that the test moves, and the events that come of them."""

    def __init__(self) -> None:
        self.nursery, self.now = PlayedNursery(), 100.0
        self.events: list[Event] = []
        self.selector = selectors.DefaultSelector()
        boxes: Any = type("NoBoxes", (), {"make": lambda *_: (), "read": lambda *_: None, "close": lambda *_: None})()
        links: Any = type("NoLinks", (), {"handed": lambda *_: ()})()
        nursery: Any = self.nursery
        self.children = Children(
            nursery, {}, self.selector, links, boxes, lambda: self.now, self.events.append,
            lambda label, line: self.events.append(Printed(label, line)),
        )  # fmt: skip
        for label in ("a", "b"):
            self.children.spawn(label)
        self.a, self.b = (self.children._children[label] for label in ("a", "b"))
        (self.said, self.printed), (self.said_by_b, _) = self.nursery.ends

    def looks(self) -> list[Event]:
        """Reads all that is there; returns the new events."""
        before = len(self.events)
        for key, mask in self.selector.select(0):
            if mask & selectors.EVENT_READ:
                self.children.look(key, mask)
        return self.events[before:]

    def hears(self, *news: ChildExited | Orphans) -> list[Event]:
        """Reads what the nursery reports; returns the new events."""
        before, self.nursery.news = len(self.events), list(news)
        os.write(self.nursery._writing, b"!")
        self.children.look(self.selector.get_key(self.nursery), selectors.EVENT_READ)
        return self.events[before:]


@pytest.fixture
def scene() -> Iterator[Scene]:
    made = Scene()
    yield made
    made.children.bury()
    assert made.nursery.closed
    made.selector.close()
    for channel, writing in made.nursery.ends:
        channel.close()
        os.close(writing)


def test_messages_and_lines_become_events_of_their_process(scene: Scene) -> None:
    scene.said.send("ready", first=7)
    scene.said_by_b.send("joined")
    os.write(scene.printed, b"one\ntwo\nthr")
    assert sorted(map(str, scene.looks())) == sorted(
        map(
            str,
            [
                Received("a", "ready", {"first": 7}),
                Received("b", "joined", {}),
                Printed("a", "one"),
                Printed("a", "two"),
            ],
        )
    )


def test_messages_and_output_of_a_process_precede_its_death(scene: Scene) -> None:
    scene.said.send("closed", facts={})
    os.write(scene.printed, b"last words\nand no end")
    found = scene.hears(ChildExited(scene.a, -9))
    assert found == [
        Received("a", "closed", {"facts": {}}), Printed("a", "last words"), Printed("a", "and no end"), Exited("a", -9)
    ]  # fmt: skip
    scene.children.send("a", "go", {})  # news that cross its end go nowhere
    scene.children.signal("a", 9)
    assert [label for label in ("a", "b") if label in scene.children._children] == ["b"]


def test_a_channel_that_is_closed_is_hung_up_once(scene: Scene) -> None:
    scene.said.close()
    assert scene.looks() == [Disconnected("a")]
    assert scene.looks() == []
    scene.children.send("a", "go", {})
    scene.children.flush()
    assert scene.hears(ChildExited(scene.a, 0)) == [Exited("a", 0)]


def test_leftover_processes_are_reported_by_name(scene: Scene) -> None:
    found = scene.hears(Orphans((scene.b, scene.a), ("sleep (process 12)",)))
    assert found == [OrphansKilled(("b", "a"), ("sleep (process 12)",))]


def ticked(scene: Scene, seconds: float) -> list[Event]:
    scene.now += seconds
    before = len(scene.events)
    scene.children.flush()
    scene.children.tick()
    return scene.events[before:]


def test_not_reading_is_reported_until_the_process_reads(scene: Scene) -> None:
    assert ticked(scene, 10.0) == []  # nothing waits for it
    for _ in range(2):
        scene.children.send("a", "grow", {"data": bytes(400_000)})
    scene.children.flush()  # what fits into the socket is taken
    waiting = scene.a.channel.waiting
    assert waiting >= 1
    assert ticked(scene, NOT_READING_AFTER) == []
    assert ticked(scene, 0.5) == [NotReading("a", NOT_READING_AFTER + 0.5, waiting)]
    while scene.a.channel.waiting or scene.a.channel.queued:
        scene.said._socket.recv(1 << 20)
        scene.children.flush()
    assert ticked(scene, 10.0) == []


def test_overflow_of_a_channel_is_reported_at_once(scene: Scene) -> None:
    for _ in range(6):
        scene.children.send("a", "grow", {"data": bytes(400_000)})
    (event,) = ticked(scene, 0.1)
    assert isinstance(event, NotReading)
    assert (event.label, event.overflowed) == ("a", True)


def test_only_the_latest_of_news_that_replace_each_other_waits(scene: Scene) -> None:
    for k in range(5):
        scene.children.send("a", "covered", {"frontier": k}, replaces=True)
    scene.children.send("a", "stop", {})
    scene.children.flush()
    assert [scene.said.receive() for _ in range(2)] == [("covered", {"frontier": 4}), ("stop", {})]


def test_a_nursery_that_is_gone_ends_the_run_and_those_that_it_has_not_started(scene: Scene) -> None:
    scene.nursery.failure = NurseryFailed("it was killed by SIGKILL")
    found = scene.hears()
    assert found == [Aborted("it was killed by SIGKILL"), Exited("a", None), Exited("b", None)]
    before = len(scene.events)
    scene.children.spawn("c")
    assert scene.events[before:] == [Aborted("it was killed by SIGKILL")]
