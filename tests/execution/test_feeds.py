"""Feeds: a window bounds what is under way, a pace is the clock's, a recording stands in for its sources."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from firing_operators import Collector, value

from dataflow.execution.feeds.log import LogFeed
from dataflow.execution.feeds.pace import Pace
from dataflow.execution.feeds.playable import span_of
from dataflow.execution.feeds.window import Window
from dataflow.recording import Recorded
from dataflow.sync import FOREVER, Entry


def test_window_fills_by_messages_or_bytes_and_empties_when_covered() -> None:
    window = Window(3, 100)
    window.add(1, 2, 10)
    assert not window.full
    window.add(2, 1, 10)
    assert window.full
    window.cover(1)
    assert (window.full, window.count, window.size) == (False, 1, 10)
    window.add(3, 1, 90)
    assert window.full
    window.grow()
    assert not window.full
    window.add(3, 5, 90)
    assert window.full
    window.clear()
    assert (window.full, window.count, window.size) == (False, 0, 0)
    window.cover(FOREVER)
    window.add(4, 1000, 1000)
    assert not window.full


def test_event_time_advances_at_its_rate_from_its_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(now=50.0)
    fake = SimpleNamespace(time=lambda: clock.now, time_ns=lambda: round(clock.now * 1e9))
    monkeypatch.setattr("dataflow.execution.feeds.pace.time", fake)
    pace = Pace(2.0)
    assert (pace.held, pace.due_in(10**9), pace.event_time()) == (False, 0.0, 50 * 10**9)
    pace.begin(10 * 10**9, 50.0)
    clock.now = 51.0

    assert pace.event_time() == 12 * 10**9
    assert pace.due_in(14 * 10**9) == pytest.approx(1.0)
    pace.change(0.5, due=14 * 10**9)
    clock.now = 53.0
    assert pace.event_time() == 13 * 10**9
    pace.change(1.0, due=12 * 10**9)  # no further than the step that waits
    assert pace.event_time() == 12 * 10**9
    pace.put(20 * 10**9)
    clock.now = 54.0
    assert pace.event_time() == 21 * 10**9
    pace.change(None, due=0)
    assert not pace.held


class Played:
    """Recorded streams: (stream, stamp, incarnation) in the order of the file, static ones first."""

    path = Path("played")
    torn = False

    def __init__(self, *given: tuple[str, int, int], static: str = "") -> None:
        seqs: dict[tuple[str, int], int] = {}
        self._given = []
        for stream, stamp, incarnation in given:
            seq = seqs[stream, incarnation] = seqs.get((stream, incarnation), -1) + 1
            self._given.append(Recorded(stream, value(stamp, stamp), seq, incarnation))
        self.streams: Mapping[str, Any] = {
            name: SimpleNamespace(
                static=name == static,
                first=min(stamps := [stamp for stream, stamp, _ in given if stream == name], default=None),
                last=max(stamps, default=None),
                incarnations=1 + max((i for stream, _, i in given if stream == name), default=0),
            )
            for name in ("t/m/map", "t/s/x", "t/s/y")
        }
        self.metadata: Mapping[str, Mapping[str, str]] = {}

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        for item in self._given:
            if self.streams[item.stream].static or (start or 0) <= item.stamp <= (FOREVER if end is None else end):
                yield item

    def stamps(self, stream: str, start: int | None = None, end: int | None = None) -> Iterator[int]:
        return (item.stamp for item in self.messages(None, start, end) if item.stream == stream)

    def opening(self) -> None:
        return None

    def close(self) -> None:
        """Holds nothing."""


class Told(Collector):
    """Keeps what a feed emits, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[tuple[Any, ...]] = []

    def message(self, stream: str, entry: Entry) -> None:
        super().message(stream, entry)
        self.told.append((stream, entry.stamp))

    def frontier(self, stream: str, frontier: int) -> None:
        self.told.append((stream, "up to", frontier))

    def end(self, stream: str, final_stamp: int | None, reason: str) -> None:
        self.told.append((stream, "ends", final_stamp, reason))


def feed(played: Played, **options: Any) -> tuple[LogFeed, Told]:
    told = Told()
    nodes = {"t/m/map": "m", "t/s/x": "s", "t/s/y": "s"}
    ports = {"m": ("t/m/map",), "s": ("t/s/x", "t/s/y")}
    return LogFeed(played, nodes, told, ports=ports, **{"finals": {}, **options}), told


def given_whole(log: LogFeed) -> None:
    log.setup()
    while log.look_ahead() is not None:
        assert log.look_ahead() is not None  # the same step
        log.admit()
    log.finish()


MAP, X, Y = "t/m/map", "t/s/x", "t/s/y"
PLAYED = (MAP, 0, 0), (X, 10, 0), (Y, 10, 0), (X, 20, 0), (X, 30, 0)


def test_static_messages_come_first_then_stamp_by_stamp_and_a_stream_ends_behind_its_last() -> None:
    log, told = feed(Played(*PLAYED, static=MAP), finals={X: 35}, start=10, end=20)
    log.setup()
    assert log.look_ahead() == 10
    log.admit()
    log.promise()
    assert told.told[-1] == (Y, 10)  # nothing is promised that a message has told
    assert log.look_ahead() == 20
    log.admit()
    log.promise()
    assert told.told[-2:] == [(Y, "ends", 10, "end of stream"), (X, 20)]
    assert log.look_ahead() is None
    log.finish()

    assert told.told[-1] == (X, "ends", 20, "end of recording")
    assert log.span() == (10, 20)


def test_a_feed_that_is_ended_early_ends_its_streams_where_it_was() -> None:
    log, told = feed(Played(*PLAYED, static=MAP))
    log.setup()
    log.look_ahead()
    log.admit()
    assert log.look_ahead() == 20

    log.finish("stopped")
    log.finish("again")

    assert told.told[-2:] == [(X, "ends", 10, "stopped"), (Y, "ends", 10, "stopped")]
    assert [(r.kind, r.operator) for r in told.records if r.kind == "finish"] == [("finish", "m"), ("finish", "s")]


def test_stream_whose_clock_went_back_ends_after_its_last_message() -> None:
    log, told = feed(Played((X, 50, 0), (X, 10, 1), (Y, 60, 0), (X, 70, 1), static=MAP))

    given_whole(log)

    assert [each for each in told.told if each[0] == X] == [
        (X, 50),
        (X, 10),
        (X, 70),
        (X, "ends", 70, "end of recording"),
    ]
    assert [r.incarnation for r in log.recording.messages() if r.stream == X] == [0, 1, 1]


def test_a_recording_plays_from_its_first_to_its_last_stamp_without_static_streams() -> None:
    assert span_of(Played(*PLAYED, static=MAP), (MAP, X, Y)) == (10, 30)
    assert span_of(Played(*PLAYED, static=MAP), (MAP,)) is None


def test_nothing_is_emitted_of_messages_that_are_no_streams_of_the_graph() -> None:
    log, told = feed(Played(static=MAP))

    given_whole(log)

    assert told.told[0] == (MAP, "ends", None, "static")
    assert log.span() is None
    assert not told.messages
