"""Playback: what may pass while it is paused, and what keys mean."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dataflow.cli.playback import pressed
from dataflow.feeds.playback import ACTIONS, Playback


def test_paused_holds_everything_until_it_goes_on() -> None:
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


@given(st.lists(st.sampled_from([*ACTIONS, "passed"])))
def test_it_holds_or_plays_and_steps_are_only_made_while_paused(actions: list[str]) -> None:
    playback = Playback()
    for action in actions:
        if action != "passed":
            playback.do(action)  # type: ignore[arg-type]
        elif not playback.holds:
            playback.passed()
        assert not (playback.stepping and not playback.paused)
        assert playback.holds == (playback.paused and not playback.stepping)


def test_an_unknown_action_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one of"):
        Playback().do("rewind")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (b" ", ["toggle"]),
        (b"\x1b[C\x1b[C", ["step", "step"]),
        (b"nq", ["step", "quit"]),
        (b"\x1b[A\x1b[D?", []),  # up, left
        (b"x n", ["toggle", "step"]),
    ],
)
def test_keys_mean_what_the_help_says(typed: bytes, meant: list[str]) -> None:
    assert list(pressed(typed)) == meant
