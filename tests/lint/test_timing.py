"""Gaps, timestamps out of order and wrong rates are named with their size and place."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lint_inputs import BEGIN, SECOND, MadeInput, every

from dataflow.lint.checks import lint
from dataflow.lint.contract import Contract
from dataflow.lint.timing import check_gaps, check_order, timing_of


def findings(stamps: dict[str, list[int]], contract: Contract | None = None) -> list[tuple[str, str]]:
    return [(f.check, f.stream) for f in lint(MadeInput({}, stamps), contract).findings]


def test_a_sound_recording_has_no_findings() -> None:
    assert findings({"a": every(0.1), "b": every(0.01)}) == []


def test_gap_is_reported_with_length_place_and_missing_messages() -> None:
    stamps = [s for s in every(0.1) if not 3.05 <= (s - BEGIN) / SECOND < 5.05]
    (found,) = lint(MadeInput({}, {"a": stamps, "b": every(0.1)})).findings
    assert (found.check, found.stream, found.at) == ("gap", "a", BEGIN + 3 * SECOND)
    assert found.values == {"gaps": 1, "longest_s": pytest.approx(2.1), "missing": 20}
    assert "the longest 2.1 s; about 20 messages are missing" in found.text


@pytest.mark.parametrize(("period", "found"), [(5e-6, [("unit", "imu")]), (0.00025, [])])
def test_a_rate_that_no_sensor_has_is_a_unit_that_is_read_wrongly(period: float, found: list[tuple[str, str]]) -> None:
    assert findings({"imu": [BEGIN + round(i * period * SECOND) for i in range(100)]}) == found


def test_events_without_a_rate_have_no_gaps() -> None:
    times = np.cumsum(np.random.default_rng(1).exponential(1.0, 200))
    assert findings({"doors": [BEGIN + int(t * SECOND) for t in times]}) == []


def test_repeated_and_backward_timestamps_are_counted() -> None:
    stamps = np.array([0, 10, 10, 20, 15, 30]) * SECOND
    repeated, back = check_order("a", stamps)
    assert (repeated.check, repeated.at, repeated.values) == ("duplicate", 10 * SECOND, {"messages": 1})
    assert (back.check, back.at) == ("backward", 15 * SECOND)
    assert back.values == {"messages": 1, "largest_s": 5.0}


def test_streams_that_begin_late_or_end_early_are_named() -> None:
    found = findings({"a": every(0.1), "late": every(0.1, 4.0), "early": every(0.1, 0.0, 6.0)})
    assert sorted(found) == [("begins", "late"), ("ends", "early")]


def test_a_contract_bounds_rates_and_gaps_and_names_streams() -> None:
    imu, camera = {"rate": [95, 105]}, {"rate": [9, 11], "max_gap": "250ms"}
    streams = {"imu": imu, "camera/*": camera, "gnss": {}, "radio": {"optional": True}}
    terms = Contract.model_validate({"streams": streams})
    stamps = {"robot1/imu": every(0.02), "robot1/camera/left": every(0.1), "robot1/camera/right": every(0.1)}
    stamps["robot1/camera/right"] = [s for s in stamps["robot1/camera/right"] if (s - BEGIN) // 10**8 not in (50, 51)]
    assert sorted(findings(stamps, terms)) == [
        ("contract", "gnss"),
        ("gap", "robot1/camera/right"),
        ("rate", "robot1/imu"),
    ]


def test_gap_allowed_by_the_contract_is_no_finding() -> None:
    stamps = {"robot1/a": [s for s in every(0.1) if not 3.0 < (s - BEGIN) / SECOND < 5.0]}
    assert findings(stamps) == [("gap", "robot1/a")]
    assert findings(stamps, Contract.model_validate({"streams": {"a": {"allow": ["gap"]}}})) == []


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=50))
def test_any_timestamps_can_be_looked_at(stamps: list[int]) -> None:
    found = np.array(stamps, np.int64)
    timing = timing_of(found)
    assert timing is not None
    assert timing.count == len(stamps)
    list(check_order("a", found))
    list(check_gaps("a", found, timing))
    repeats = sum(a == b for a, b in pairwise(stamps))
    assert sum((f.values or {})["messages"] for f in check_order("a", found) if f.check == "duplicate") == repeats
