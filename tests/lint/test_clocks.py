"""Clocks that are off or drift are found with sign and size, in what a simulated robot records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lint_inputs import MadeInput, simulated

import dataflow
from dataflow.lint.checks import Report, lint
from dataflow.lint.clocks import clock_difference
from dataflow.lint.contract import Contract
from dataflow.lint.turning import Turning, turning_of
from operators.sources import SyntheticRgbd


def turning(times: np.ndarray, rate, offset: float = 0.0, drift: float = 0.0) -> Turning:
    """A stream that sees the mean of `rate` over its intervals, with timestamps late by offset + drift · time."""
    true = (times - offset) / (1 + drift)
    fine = np.linspace(true[0], true[-1], 20_000)
    turned = np.concatenate([[0.0], np.cumsum(np.diff(fine) * (rate(fine[1:]) + rate(fine[:-1])) / 2)])
    at = np.interp(true, fine, turned)
    return Turning(times[:-1], times[1:], np.diff(at) / np.diff(times))


def swaying(t: np.ndarray) -> np.ndarray:
    return np.abs(np.sin(0.7 * t) + 0.6 * np.sin(1.9 * t + 1) + 0.3 * np.sin(4.3 * t))


@pytest.mark.long
@settings(max_examples=25)
@given(st.floats(-0.4, 0.4), st.floats(-0.003, 0.003), st.sampled_from([0.03, 0.05, 0.1]))
def test_any_offset_and_drift_is_found_with_its_sign(offset: float, drift: float, period: float) -> None:
    reference = turning(np.arange(0.0, 40.0, 0.01), swaying)
    found = clock_difference(turning(np.arange(1.0, 39.0, period), swaying, offset, drift), reference)
    assert found is not None
    middle = offset + drift * (20.0 - offset)
    assert found.offset == pytest.approx(middle, abs=0.003)
    assert found.drift == pytest.approx(drift, abs=3e-4)


def test_two_that_do_not_turn_alike_tell_nothing() -> None:
    times = np.arange(0.0, 30.0, 0.02)
    noise = np.random.default_rng(3).uniform(0, 1, len(times) - 1)
    still = Turning(times[:-1], times[1:], np.zeros(len(times) - 1))
    assert clock_difference(Turning(times[:-1], times[1:], noise), turning(times, swaying)) is None
    assert clock_difference(still, turning(times, swaying)) is None
    assert clock_difference(turning(times[:20], swaying), turning(times, swaying)) is None


def test_a_few_seconds_tell_nothing_however_alike_they_are() -> None:
    reference = turning(np.arange(0.0, 40.0, 0.01), swaying)
    assert clock_difference(turning(np.arange(1.0, 5.0, 0.03), swaying), reference) is None
    assert clock_difference(turning(np.arange(1.0, 12.0, 0.03), swaying), reference) is not None


def test_implausible_clock_drift_is_rejected() -> None:
    reference = turning(np.arange(0.0, 40.0, 0.01), swaying)
    assert clock_difference(turning(np.arange(5.0, 35.0, 0.03), swaying, drift=0.05), reference) is None


@pytest.mark.long
def test_a_camera_that_sways_for_four_seconds_has_no_clock_to_be_judged(tmp_path: Path) -> None:
    graph = dataflow.Graph("short")
    graph.add("camera", SyntheticRgbd, frames=120, rate=30, width=160, height=120)
    graph.run(record=tmp_path / "short.mcap")

    with dataflow.open(tmp_path / "short.mcap") as recording:
        images, poses = recording["image"], recording["ground_truth"]
        seen = turning_of(images, "Image", int(images.stamps[0]))
        true = turning_of(poses, "Pose", int(images.stamps[0]))
    assert seen is not None
    assert true is not None
    assert clock_difference(seen, true) is None


def report(contract: Contract | None = None, **sensors: object) -> Report:
    return lint(MadeInput(simulated(**sensors)), contract)


def clock_findings(found: Report) -> dict[tuple[str, str], dict[str, float]]:
    return {(f.check, f.stream): dict(f.values or {}) for f in found.findings if f.check.startswith("clock")}


@pytest.mark.long
def test_a_robot_with_good_clocks_is_sound() -> None:
    found = report()
    assert found.findings == []
    assert {"robot1/imu", "robot1/ground_truth", "robot1/wheel_ticks", "robot1/wheel_odometry"} <= set(found.clocks)


@pytest.mark.long
@pytest.mark.parametrize("delay", [60, 150])
def test_a_late_gyroscope_is_named_by_its_offset_against_all_others(delay: int) -> None:
    found = clock_findings(report(inertial={"delay": f"{delay}ms"}))
    assert list(found) == [("clock offset", "robot1/imu")]
    assert found["clock offset", "robot1/imu"]["offset_ms"] == pytest.approx(delay, abs=3)


@pytest.mark.long
def test_a_gyroscope_whose_clock_drifts_is_named_with_sign_and_rate() -> None:
    found = clock_findings(report(inertial={"clock_drift": 0.004}))
    assert list(found) == [("clock drift", "robot1/imu")]
    assert found["clock drift", "robot1/imu"]["drift_ms_per_s"] == pytest.approx(4.0, abs=0.2)


@pytest.mark.long
def test_the_sign_is_turned_where_the_contract_trusts_the_gyroscope() -> None:
    trusted = Contract.model_validate({"clocks": {"reference": "imu"}})
    found = clock_findings(report(trusted, inertial={"delay": "150ms"}))
    assert ("clock offset", "robot1/imu") not in found
    assert found["clock offset", "robot1/ground_truth"]["offset_ms"] == pytest.approx(-150, abs=3)


@pytest.mark.long
def test_wheel_outage_is_a_gap_and_clocks_are_still_estimated() -> None:
    found = report(wheels={"outages": [[10, 13]]})
    gaps = {f.stream: dict(f.values or {}) for f in found.findings if f.check == "gap"}
    assert set(gaps) == {"robot1/wheel_ticks", "robot1/wheel_odometry"}
    assert gaps["robot1/wheel_ticks"]["longest_s"] == pytest.approx(3.0, abs=0.11)
    assert gaps["robot1/wheel_ticks"]["missing"] == pytest.approx(60, abs=1)
    assert clock_findings(found) == {}
