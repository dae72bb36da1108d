"""The environments of re-runs."""

from __future__ import annotations

import pytest

from dataflow.causes.rerun import RerunSettings
from dataflow.causes.sources import CHANCE, COMPILED, MONOTONIC, VARIABLE, WALL, named


def test_the_other_moment_of_compiled_clocks_differs_below_the_second_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.causes.rerun.fake_time", lambda: "libfaketime.so.1")

    fixed = RerunSettings(frozenset({COMPILED})).environment()["FAKETIME"]
    varied = RerunSettings(varied=frozenset({COMPILED})).environment()["FAKETIME"]

    assert float(fixed[17:]) % 1 != float(varied[17:]) % 1


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (RerunSettings(log=True), "its reads are logged"),
        (RerunSettings(lines=True), "its lines are watched"),
        (RerunSettings(), "once more as it is"),
        (RerunSettings(frozenset(CHANCE)), "all sources of chance fixed"),
        (RerunSettings(frozenset(CHANCE) - {WALL, MONOTONIC}, frozenset({WALL})), "free: wall clock, monotonic clock"),
        (RerunSettings(varied=frozenset({named(VARIABLE, "GAIN")})), "changed: environment variable GAIN"),
        (RerunSettings(varied=frozenset("abcde")), "changed: a, b, c and 2 more"),
    ],
)
def test_rerun_describes_its_setting(setting: RerunSettings, words: str) -> None:
    assert setting.words == words
