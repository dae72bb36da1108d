"""The environments of re-runs."""

from __future__ import annotations

import pytest

from dataflow.causes.rerun import Setting
from dataflow.causes.sources import COMPILED


def test_the_other_moment_of_compiled_clocks_differs_below_the_second_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.causes.rerun.fake_time", lambda: "libfaketime.so.1")

    fixed = Setting(frozenset({COMPILED})).environment()["FAKETIME"]
    varied = Setting(varied=frozenset({COMPILED})).environment()["FAKETIME"]

    assert float(fixed[17:]) % 1 != float(varied[17:]) % 1
