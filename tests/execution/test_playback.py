"""Playback: what may pass while it is paused, and what keys mean."""

from __future__ import annotations

import os
import pty
import termios
import threading

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from dataflow.cli.commands.playback import ENDING, KEEPING, PLAYING, KeyBindings, _steered, keys, looped, pressed
from dataflow.execution.feeds.playback import ACTIONS, FASTEST, SLOWEST, Playback


def test_pause_holds_playback_until_resumed() -> None:
    playback = Playback(paused=True)
    assert playback.holds
    playback.do("toggle")
    assert not playback.holds
    playback.do("toggle")
    assert playback.holds


def test_steps_pass_one_by_one_without_the_clock() -> None:
    playback = Playback()
    playback.do("step", 2)
    for left in (True, False):
        assert playback.stepping
        playback.passed()
        assert playback.stepping is left
    assert playback.holds


def test_speed_is_doubled_halved_and_chosen() -> None:
    playback = Playback(speed=1.0)
    playback.do("faster")
    assert playback.speed == 2.0
    playback.do("slower")
    assert playback.speed == 1.0
    playback.do("slower")
    assert playback.speed == 0.5
    for _ in range(20):
        playback.do("slower")
    assert playback.speed == SLOWEST
    playback.do("speed", speed=FASTEST)
    playback.do("faster")
    assert playback.speed is None
    playback.do("faster")
    assert playback.speed is None
    playback.do("slower")
    assert playback.speed == 1.0
    playback.do("speed", speed=0.001)
    playback.do("slower")
    assert playback.speed == 0.001
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="expected a factor of real time above 0"):
            playback.do("speed", speed=wrong)


@given(st.lists(st.sampled_from([*ACTIONS, "passed"])))
def test_it_holds_or_plays_and_steps_are_only_made_while_paused(actions: list[str]) -> None:
    playback = Playback()
    for action in actions:
        if action != "passed":
            playback.do(action)
        elif not playback.holds:
            playback.passed()
        assert not (playback.stepping and not playback.paused)
        assert playback.holds == (playback.paused and not playback.stepping)


def test_an_unknown_action_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one of"):
        Playback().do("rewind")


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (b" ", ["toggle"]),
        (b"\x1b[C\x1b[C", ["step", "step"]),
        (b"nq", ["step", "quit"]),
        (b"+\x1b[A=", ["faster", "faster", "faster"]),
        (b"-\x1b[B", ["slower", "slower"]),
        (b"\x1b[H\x1b[D?", []),  # home, left
        (b"x n", ["toggle", "step"]),
    ],
)
def test_keys_match_the_help_text(typed: bytes, meant: list[str]) -> None:
    assert list(pressed(typed)) == meant


@pytest.mark.parametrize(
    ("offers", "meant"),
    [
        ((PLAYING, KEEPING, ENDING), ["toggle", "step", "the key k", "step", "stop"]),
        ((PLAYING, ENDING), ["toggle", "step", "step", "stop"]),
        ((KEEPING, ENDING), ["the key k", "stop"]),
    ],
    ids=["flight recorder", "no flight recorder", "live"],
)
def test_terminal_keys_control_playback_and_restore_the_terminal(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    offers: tuple[KeyBindings, ...],
    meant: list[str],
) -> None:
    master, slave = pty.openpty()
    done: list[str] = []
    came = threading.Event()

    class Steered:
        def play(self, action: str) -> None:
            done.append(action)

        def trigger(self, text: str) -> None:
            done.append(text)

        def stop(self) -> None:
            done.append("stop")
            came.set()

    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        before = termios.tcgetattr(terminal)
        with _steered(offers, Steered()):
            os.write(master, b" nk\x1b[Cq")
            assert came.wait(10)
        after = termios.tcgetattr(terminal)
    os.close(master)

    assert done == meant
    assert after == before
    told = " ".join(capsys.readouterr().err.split())
    assert ("k: save the history" in told) is (KEEPING in offers)


def test_a_job_in_the_background_reads_no_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal that is not this process group's to read."""
    master, slave = pty.openpty()
    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        monkeypatch.setattr("dataflow.cli.commands.playback.err", Console(force_terminal=True))
        assert keys(False) is None
    os.close(master)


def test_passes_of_a_loop_are_compared(capsys: pytest.CaptureFixture[str]) -> None:
    digests = iter([{"s": "a"}, {"s": "a"}, {"s": "b"}])

    looped(2, lambda: next(digests))
    assert "2 passes, the same digests in each" in capsys.readouterr().out

    digests = iter([{"s": "a"}, {"s": "b"}])
    with pytest.raises(typer.Exit) as ended:
        looped(2, lambda: next(digests))
    assert ended.value.exit_code == 1
