"""A recording is played as its clock says: paused, faster, from another place; on a clock of the test's own."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_recordings import recorded

from dataflow.foxglove.player import Clock, play
from dataflow.messages import Message, Number, Transforms
from dataflow.recording import Recorded, Recording

SECOND = 10**9


class Wall:
    """A wall clock that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def recording(tmp_path: Path) -> Iterator[Recording]:
    rows: list[tuple[str, Message]] = [
        (stream, Number(stamp=(10 + k) * SECOND, value=float(k)))
        for stream, step in (("r/fast/y", 1), ("r/slow/y", 4))
        for k in range(0, 10, step)
    ]
    rows.append(("r/mount/frames", Transforms.from_matrix(np.eye(4), stamp=0, frame="base", child_frame="camera")))
    path = recorded(tmp_path / "r.mcap", rows, static=["r/mount/frames"], namespace="r")
    with Recording(path) as opened:
        yield opened


def played(recording: Recording, clock: Clock, script: dict[str, str]) -> list[str]:
    """What is shown, as `stream stamp`, with `|` for an arrival; `script`: what a client asks for after a message."""
    shown: list[str] = []

    def note(what: str) -> None:
        shown.append(what)
        match script.pop(what, "").split():
            case ["close"]:
                clock.close()
            case ["pause"]:
                clock.request(playing=False, speed=0, seek=None)
            case ["seek", stamp]:
                clock.request(playing=True, speed=1e6, seek=int(stamp) * SECOND)

    def show(recorded: Recorded) -> None:
        note(f"{recorded.stream.split('/')[1]} {recorded.stamp // SECOND}")

    play(recording, list(recording.streams), clock, show, arrived=lambda: note("|"), ended=lambda: note("end"))
    return shown


def test_everything_is_shown_once_in_the_order_of_its_stamps_static_streams_first(recording: Recording) -> None:
    shown = played(recording, Clock(10 * SECOND, 19 * SECOND, speed=1e6), {"end": "close"})

    times = [f"fast {t}" for t in range(10, 20)] + ["slow 10", "slow 14", "slow 18"]
    assert shown[0] == "mount 0"
    assert sorted(x for x in shown[1:-1] if x != "|") == sorted(times)
    assert shown[-1] == "end"


def test_seek_shows_the_latest_messages_and_continues(recording: Recording) -> None:
    shown = played(recording, Clock(10 * SECOND, 19 * SECOND, speed=1e6), {"fast 17": "seek 13", "end": "close"})

    there = shown.index("fast 17") + 1
    assert shown[there : there + 3] == ["slow 10", "fast 13", "|"]
    assert shown[there + 3] == "fast 14"
    assert shown.count("fast 19") == 1


def test_at_its_end_it_waits_for_another_jump(recording: Recording) -> None:
    ends: list[str] = []
    clock = Clock(10 * SECOND, 19 * SECOND, speed=1e6)

    def ended() -> None:
        ends.append("end")
        if len(ends) == 1:
            clock.request(playing=True, speed=1e6, seek=18 * SECOND)
        else:
            clock.close()

    shown: list[int] = []
    play(recording, ["r/fast/y"], clock, lambda recorded: shown.append(recorded.stamp // SECOND), ended=ended)

    assert shown == [*range(10, 20), 18, 19]
    assert len(ends) == 2


def test_time_stands_while_paused_and_passes_by_the_speed() -> None:
    wall = Wall()
    clock = Clock(0, 100 * SECOND, now=wall)
    wall.now += 7
    assert clock.state() == (True, 0, 1.0)
    clock.begin()
    wall.now += 2
    assert clock.state() == (True, 2 * SECOND, 1.0)
    clock.request(playing=False, speed=0.5, seek=None)
    wall.now += 5
    assert clock.state() == (False, 2 * SECOND, 0.5)
    clock.request(playing=True, speed=4, seek=10 * SECOND)
    wall.now += 3
    assert clock.state() == (True, 10 * SECOND, 4.0)
    clock.begin()
    wall.now += 3
    assert clock.state() == (True, 22 * SECOND, 4.0)
    assert clock.jumps() == 1
    wall.now += 1000
    assert clock.state()[1] == 100 * SECOND
    clock.request(playing=True, speed=1, seek=-5)
    assert clock.state()[1] == 0


def test_waiting_for_a_stamp_ends_at_a_seek_and_at_the_end() -> None:
    for wake in (lambda clock: clock.request(playing=True, speed=1, seek=0), Clock.close):
        clock = Clock(0, 10**15)
        timer = threading.Timer(0.01, wake, [clock])
        timer.start()
        assert not clock.reached(10**14, 0)
        timer.join()
