"""The pipe gives every frame once and in order, whatever its link loses; beyond its bound it drops what may be."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from dataflow.machines import pipe as pipes
from dataflow.machines.pipe import Clocks, Pipe, SendWindow


class Link:
    """What stands for Zenoh between two pipes; `loses` decides which payloads on `.../frames` do not arrive."""

    def __init__(self) -> None:
        self._takers: dict[str, Callable[[Any], None]] = {}
        self.loses: Callable[[bytes], bool] = lambda payload: False
        self.session = self

    def declare_publisher(self, key: str, **_: Any) -> Any:
        return SimpleNamespace(put=lambda payload: self._put(key, payload))

    def declare_subscriber(self, key: str, handler: Any) -> Any:
        self._takers[key] = handler.callback
        return SimpleNamespace(undeclare=lambda: self._takers.pop(key))

    def _put(self, key: str, payload: bytes) -> None:
        taker = self._takers.get(key)
        if taker is not None and not (key.endswith("/frames") and self.loses(payload)):
            taker(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


@pytest.fixture
def link(monkeypatch: pytest.MonkeyPatch) -> Link:
    monkeypatch.setattr(pipes, "BEAT_EVERY", 0.01)
    monkeypatch.setattr(zenoh.handlers, "Callback", lambda callback, indirect: SimpleNamespace(callback=callback))
    return Link()


Ends = Callable[..., Pipe]


@pytest.fixture
def ends(link: Link) -> Iterator[Ends]:
    """Makes both ends of a pipe, of which the second gives what it takes to a list; returns the first."""
    made: list[Pipe] = []

    def both(taken: list[bytes], *, bounded: bool = False) -> Pipe:
        bus: Any = link
        made.append(Pipe(bus, "there", "here", lambda frame: None, bounded=bounded))
        made.append(Pipe(bus, "here", "there", taken.append, bounded=False))
        return made[0]

    yield both
    for pipe in made:
        pipe.close()


def emptied(pipe: Pipe) -> bool:
    deadline = time.monotonic() + 20
    while not pipe.idle and time.monotonic() < deadline:
        time.sleep(0.005)
    return pipe.idle


def test_frames_of_a_link_that_loses_arrive_once_and_in_order(link: Link, ends: Ends) -> None:
    taken: list[bytes] = []
    passed = iter(range(1_000_000))
    link.loses = lambda payload: next(passed) % 7 in (2, 3)  # single ones, pairs, and those that are sent again
    a = ends(taken)

    for k in range(300):
        a.send(b"%d" % k)

    assert emptied(a)
    assert taken == [b"%d" % k for k in range(300)]
    assert a.dropped == 0


def test_loss_of_last_frame_is_detected_by_the_mark(link: Link, ends: Ends) -> None:
    taken: list[bytes] = []
    lost: list[bytes] = []
    link.loses = lambda payload: payload.endswith(b"last") and not lost and not lost.append(payload)
    a = ends(taken)

    a.send(b"last")

    assert emptied(a)
    assert taken == [b"last"]
    assert lost


def test_queue_of_a_dead_link_is_bounded_and_keeps_lossless_messages(
    link: Link, ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipes, "MOST_WAITING", 1000)
    monkeypatch.setattr(pipes, "IN_FLIGHT", 1)
    taken: list[bytes] = []
    link.loses = lambda payload: True
    a = ends(taken, bounded=True)
    a.send(b"first")
    time.sleep(0.05)  # it is on its way

    for k in range(100):
        a.send(b"%02d" % k * 50, droppable=k % 10 != 0)
    link.loses = lambda payload: False

    assert emptied(a)
    kept = [int(frame[:2]) for frame in taken[1:]]
    assert {*range(0, 100, 10)} <= set(kept)  # beyond the bound alone, since they may not be dropped
    assert kept == sorted(kept)
    assert a.dropped == 100 - len(kept) > 80


@pytest.mark.parametrize("size", [0, 1, pipes.PIECE, pipes.PIECE + 1, 5 * pipes.PIECE, 1_000_003])
def test_a_long_frame_goes_in_pieces_and_comes_whole(link: Link, ends: Ends, size: int) -> None:
    taken: list[bytes] = []
    sizes: list[int] = []
    passed = iter(range(1_000_000))
    link.loses = lambda payload: sizes.append(len(payload)) or next(passed) % 5 == 2
    a = ends(taken)
    frames = [b"before", bytes(range(256)) * (size // 256) + b"e" * (size % 256), b"behind"]

    for frame in frames:
        a.send(frame)

    assert emptied(a)
    assert taken == frames
    assert max(sizes) <= pipes.PIECE + 100


class SlowLink:
    """A link that takes any number of bytes, in steps of a millisecond: what stands in it delays what follows."""

    def __init__(self, rate: float, delay: float) -> None:
        self.rate, self.delay = rate, delay
        self.room = SendWindow()
        self.now = self.free = 0.0
        self.flying: list[tuple[float, float]] = []  # of each piece: when it was sent, when it is acknowledged
        self.delivered = 0

    def go(self, seconds: float, *, stands: bool = False) -> float:
        """Sends as much as there is room for; returns how long (s) a beat would wait at the most."""
        worst, end = 0.0, self.now + seconds
        if stands:
            self.free = max(self.free, self.now) + seconds
            self.flying = [(sent, at + seconds) for sent, at in self.flying]
        while self.now < end:
            self.now += 0.001
            while self.flying and self.flying[0][1] <= self.now:
                filled = len(self.flying) * pipes.PIECE >= self.room.bytes - pipes.PIECE
                sent, _ = self.flying.pop(0)
                self.delivered += pipes.PIECE
                self.room.taken(sent, self.now, pipes.PIECE, filled=filled)
            while len(self.flying) * pipes.PIECE < self.room.bytes:
                self.free = max(self.free, self.now) + pipes.PIECE / self.rate
                self.flying.append((self.now, self.free + self.delay))
            worst = max(worst, self.free - self.now)
        return worst


@pytest.mark.parametrize("delay", [0.002, 0.3])
@pytest.mark.parametrize("rate", [125e3, 1e6, 20e6])
def test_saturated_slow_link_delays_heartbeats_below_the_timeout(rate: float, delay: float) -> None:
    link = SlowLink(rate, delay)

    assert link.go(20) < pipes.AWAY_AFTER
    link.go(10, stands=True)
    link.go(10)
    assert link.go(10) < pipes.AWAY_AFTER
    before = link.delivered
    link.go(10)
    assert link.delivered - before > 0.8 * min(rate, pipes.IN_FLIGHT_BYTES / delay) * 10
    link.rate = rate / 8  # the robot has driven away
    link.go(10)
    assert link.go(10) < pipes.AWAY_AFTER or link.rate < 20e3


def test_the_offset_of_clocks_is_that_of_the_shortest_exchange() -> None:
    clocks = Clocks()
    assert clocks.best is None
    clocks.exchanged(asked=100, taken=1600, answered=1700, heard=1200)  # 500 there, 500 back: 1000 ahead
    assert clocks.best == (1000, 1000)
    clocks.exchanged(asked=2000, taken=3010, answered=3020, heard=2030)  # 10 there, 10 back
    clocks.exchanged(asked=3000, taken=4900, answered=4900, heard=3920)  # 900 there, 20 back
    assert clocks.best == (20, 1000)


def test_exchanges_from_before_a_clock_was_set_are_forgotten() -> None:
    clocks = Clocks()
    for k in range(10):
        clocks.exchanged(asked=k * 1000, taken=k * 1000 + 5, answered=k * 1000 + 5, heard=k * 1000 + 10)
    clocks.exchanged(asked=11_000, taken=11_005, answered=61_005, heard=11_010)  # set ahead in the midst
    assert clocks.best == (10, 0)

    clocks.exchanged(asked=12_000, taken=62_020, answered=62_020, heard=12_040)

    assert clocks.best == (40, 50_000)


def test_queue_is_seldom_scanned_for_droppable_messages(
    link: Link, ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipes, "MOST_WAITING", 10_000)
    looks: list[int] = []
    drop = Pipe._drop_oldest

    def look(pipe: Pipe) -> None:
        looks.append(1)
        drop(pipe)

    monkeypatch.setattr(Pipe, "_drop_oldest", look)
    link.loses = lambda payload: True
    a = ends([], bounded=True)

    for _ in range(1000):
        a.send(b"x" * 100, droppable=True)
    assert a.dropped > 800
    assert len(looks) <= 100  # a tenth of the bound at once
    looks.clear()
    for _ in range(1000):
        a.send(b"x" * 100)
    assert len(looks) <= 101


def test_message_sent_with_beat_overtakes_frames(link: Link, ends: Ends) -> None:
    taken: list[bytes] = []
    link.loses = lambda payload: True
    a = ends(taken)
    a.send(b"frame")

    a.send_with_beat(b"word")

    assert taken == [b"word"]
    link.loses = lambda payload: False
    assert emptied(a)
    assert taken == [b"word", b"frame"]
