"""A playback bar pauses a replay and changes its speed; it refuses to jump and says what would do it."""

from __future__ import annotations

from typing import Any

import pytest

from dataflow.client.attach import NotRunning
from dataflow.client.playback import ReplayBar

FIRST = 1_700_000_000 * 10**9


class Replay:
    """Answers as a replay does."""

    def __init__(self, *, speed: float | None = None) -> None:
        self.standing: dict[str, Any] = {
            "paused": False, "ended": False, "speed": speed, "stamp": None,
            "replay": {"span": [FIRST + 2 * 10**9, FIRST + 10 * 10**9], "first": FIRST},
        }  # fmt: skip
        self.asked: list[tuple[str, float | None]] = []
        self.busy = False

    def ask(
        self, action: str | None, steps: int = 1, speed: float | None = None, *, timeout: float = 5.0
    ) -> dict[str, Any]:
        if self.busy:
            raise NotRunning("did not answer")
        if action is not None:
            self.asked.append((action, speed))
            self.standing["paused"] = {"pause": True, "resume": False}.get(action, self.standing["paused"])
            self.standing["speed"] = speed if action == "speed" else self.standing["speed"]
        return dict(self.standing)


@pytest.fixture
def replay() -> Replay:
    return Replay()


@pytest.fixture
def bar(replay: Replay) -> ReplayBar:
    return ReplayBar(replay, replay.ask(None))


def test_pause_and_resume_keep_the_speed(replay: Replay, bar: ReplayBar) -> None:
    assert bar.state() == (True, FIRST + 2 * 10**9, 1.0)
    assert bar.request(playing=False, speed=1.0, seek=None) is None
    assert bar.state()[0] is False
    assert bar.request(playing=True, speed=1.0, seek=None) is None
    assert replay.asked == [("pause", None), ("resume", None)]


def test_it_changes_the_speed_alone(replay: Replay, bar: ReplayBar) -> None:
    bar.request(playing=True, speed=0.5, seek=None)
    bar.request(playing=True, speed=0.5, seek=None)
    assert replay.asked == [("speed", 0.5)]
    assert bar.state()[2] == 0.5


def test_a_jump_is_refused_with_the_option_that_begins_there(replay: Replay, bar: ReplayBar) -> None:
    why = bar.request(playing=True, speed=1.0, seek=FIRST + 5_250_000_000)
    assert why is not None
    assert "cannot jump" in why
    assert why.endswith("--start 5.250")
    assert (bar.request(playing=True, speed=1.0, seek=FIRST) or "").endswith("--start 2.000")  # the span begins there
    assert not replay.asked


def test_keys_in_its_terminal_move_the_bar_too(replay: Replay, bar: ReplayBar) -> None:
    replay.standing |= {"paused": True, "stamp": FIRST + 3 * 10**9, "speed": 4.0}
    bar.refresh()
    assert bar.state() == (False, FIRST + 3 * 10**9, 4.0)


def test_unanswered_request_leaves_the_bar_unchanged_and_is_reported(replay: Replay, bar: ReplayBar) -> None:
    replay.busy = True
    bar.refresh()
    assert bar.request(playing=False, speed=1.0, seek=None) == "did not answer"
    assert bar.state()[0] is True


def test_one_that_has_ended_does_not_play(replay: Replay, bar: ReplayBar) -> None:
    replay.standing["ended"] = True
    bar.refresh()
    assert bar.ended
    assert bar.state()[0] is False
