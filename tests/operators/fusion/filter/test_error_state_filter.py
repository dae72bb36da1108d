"""The filter puts late measurements in their place, doubts outliers, and finds back after it was wrong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_motion import Motion

from dataflow.execution.snapshots import pack_state, unpack_state
from operators.fusion.filter.error_state import Noise
from operators.fusion.filter.error_state_filter import ErrorStateFilter, FilterConfig
from operators.fusion.filter.gate import GateConfig
from operators.fusion.filter.history import Sample
from operators.fusion.filter.hypotheses import reduced
from operators.fusion.filter.initialisation import Prior, first_node
from operators.fusion.filter.measurements import Measurement, Position

NOISE = Noise(gyro=2e-3, accel=2e-2, gyro_walk=1e-4, accel_walk=1e-3)
RATE = 50
MOTION = Motion()
Array = np.ndarray


class Made:
    """Samples and fixes of one motion."""

    def __init__(self, seconds: float = 6.0, seed: int = 1, sigma: float = 0.03) -> None:
        rng = np.random.default_rng(seed)
        self.t = np.arange(int(seconds * RATE)) / RATE
        gyro, accel = MOTION.readings(self.t)
        gyro = gyro + [0.01, -0.02, 0.015] + NOISE.gyro * RATE**0.5 * rng.standard_normal(gyro.shape)
        accel = accel + [0.05, 0.03, -0.04] + NOISE.accel * RATE**0.5 * rng.standard_normal(accel.shape)
        self.samples = [Sample(ns(x), w, f, NOISE) for x, w, f in zip(self.t, gyro, accel, strict=True)]
        self.fixes = [
            Measurement(
                ns(x) + 3_000_000,
                "fix",
                Position(MOTION.position(x + 0.003) + sigma * rng.standard_normal(3), np.zeros(3)),
                np.eye(3) * sigma**2,
            )
            for x in self.t[26::5]
        ]

    def filter(self, heading: float | None = 0.0, **config: object) -> ErrorStateFilter:
        prior = Prior(heading=heading, position_sigma=10.0)
        node = first_node(self.samples[:25], prior, 9.80665, at_rest=True)
        return ErrorStateFilter(FilterConfig(**config), node)

    def fed(self, filter: ErrorStateFilter, fixes: list[Measurement]) -> Array:
        """Gives all in the order of time; returns the errors of the position (N,) and their times."""
        waiting, rows = list(fixes), []
        for k in range(25, len(self.t)):
            filter.feel(self.samples[k])
            while waiting and waiting[0].time <= self.samples[k].time:
                filter.measure(waiting.pop(0))
            at, _ = filter.estimate(self.samples[k].time)
            rows.append([self.t[k], np.linalg.norm(at.position - MOTION.position(self.t[k]))])
        return np.array(rows)


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def displaced(fix: Measurement, by: Array) -> Measurement:
    return Measurement(fix.time, fix.sensor, Position(fix.model.value + by, np.zeros(3)), fix.noise)


def bits(filter: ErrorStateFilter) -> list[bytes]:
    at, _ = filter.estimate(filter.time)
    return [getattr(at, name).tobytes() for name in ("position", "velocity", "rotation", "gyro_bias", "covariance")]


def test_the_position_is_followed_and_the_biases_found() -> None:
    made = Made(8.0)
    filter = made.filter()
    errors = made.fed(filter, made.fixes)
    assert np.sqrt((errors[100:, 1] ** 2).mean()) < 0.04  # a fix alone is 0.052 off
    at, _ = filter.estimate(filter.time)
    np.testing.assert_allclose(at.gyro_bias, [0.01, -0.02, 0.015], atol=5e-3)


@pytest.mark.long
@settings(max_examples=8)
@given(st.lists(st.integers(0, 12), min_size=22, max_size=22))
def test_late_measurements_give_the_bits_of_those_in_time(lateness: list[int]) -> None:
    made = Made(2.6)
    inorder, late = made.filter(), made.filter()
    last = made.samples[-1].time
    entries: list[Sample | Measurement] = [*made.samples[25:], *made.fixes]
    delay = {id(fix): by * 20_000_000 for fix, by in zip(made.fixes, lateness, strict=False)}
    for filter, arrival in ((inorder, lambda e: e.time), (late, lambda e: min(e.time + delay.get(id(e), 0), last))):
        for entry in sorted(entries, key=arrival):
            if isinstance(entry, Sample):
                filter.feel(entry)
            else:
                assert filter.measure(entry)
    assert bits(inorder) == bits(late)
    assert {k: h.used for k, h in inorder.health.items()} == {k: h.used for k, h in late.health.items()}


def test_late_measurements_are_ignored_and_counted() -> None:
    made = Made(4.0)
    filter = made.filter(window=0.5)
    made.fed(filter, made.fixes[3:])
    before = bits(filter)
    assert not filter.measure(made.fixes[0])
    assert filter.ignored == {"fix: too late": 1}
    filter.feel(made.samples[50])
    assert filter.ignored["inertial sample not later than the last"] == 1
    assert bits(filter) == before


def test_outliers_are_refused() -> None:
    made = Made()
    rng = np.random.default_rng(5)
    fixes = [displaced(f, rng.normal(0, 0.7, 3)) if k > 5 and k % 6 == 0 else f for k, f in enumerate(made.fixes)]
    filter = made.filter()
    errors = made.fed(filter, fixes)
    assert filter.health["fix"].refused == sum(k > 5 and k % 6 == 0 for k in range(len(fixes)))
    assert errors[60:, 1].max() < 0.1


def test_an_outlier_right_after_an_outage_waits_for_a_second_opinion() -> None:
    made = Made(8.0)
    kept = [f for f in made.fixes if not 3e9 <= f.time < 6e9]
    first = next(k for k, f in enumerate(kept) if f.time >= 6e9)
    kept[first] = displaced(kept[first], np.array([0.3, -0.3, 0.3]))
    filter = made.filter()
    errors = made.fed(filter, kept)
    assert errors[errors[:, 0] > 6.4, 1].max() < 0.1
    assert filter.health["fix"].unconfirmed + filter.health["fix"].refused >= 2


def test_a_filter_that_is_wrong_yields_to_measurements_that_agree() -> None:
    made = Made(6.0)
    shift = np.array([3.0, -2.0, 1.0])
    fixes = [displaced(f, shift) if f.time > 3e9 else f for f in made.fixes]
    filter = made.filter()
    made.fed(filter, fixes)
    at, _ = filter.estimate(filter.time)
    assert np.linalg.norm(at.position - shift - MOTION.position(made.t[-1])) < 0.15
    assert filter.health["fix"].widened >= 1
    stubborn = made.filter(gate=GateConfig(agreeing=10**6))
    made.fed(stubborn, fixes)
    assert stubborn.health["fix"].widened == 0
    assert stubborn.health["fix"].refused > 20


def test_an_unknown_heading_is_found_by_moving() -> None:
    made = Made(8.0)
    filter = made.filter(heading=None)
    assert filter.hypotheses == 12
    errors = made.fed(filter, made.fixes)
    assert filter.hypotheses == 1
    assert errors[-100:, 1].max() < 0.12
    at, _ = filter.estimate(filter.time)
    off = MOTION.rotation(made.t[-1]).as_matrix().T @ at.rotation
    assert np.degrees(np.arccos((np.trace(off) - 1) / 2)) < 3


def test_a_gap_of_the_inertial_sensor_costs_confidence() -> None:
    made = Made(4.0)
    filter = made.filter()
    del made.samples[100:130]
    made.t = np.delete(made.t, np.s_[100:130])
    made.fed(filter, [f for f in made.fixes if f.time < 2e9])
    sure, _ = filter.estimate(filter.time)
    assert np.sqrt(np.trace(sure.covariance[:3, :3])) > 0.3


def test_without_inertial_sensor_the_velocity_stays() -> None:
    prior = Prior(heading=0.0, position_sigma=10.0, gyro_bias=0.5, accel_bias=1e-3, moving_velocity=5.0)
    up = np.array([0.0, 0.0, 9.80665])
    samples = [Sample(k, np.zeros(3), up, Noise(1e-3, 1e-3, 0, 0)) for k in (-1, 0)]
    config = FilterConfig(inertial=False, unknown=Noise(0.0, 0.05, 0.05, 0.0))
    filter = ErrorStateFilter(config, first_node(samples, prior, 9.80665, at_rest=False))
    for k in range(1, 40):
        place = np.array([0.1 * k, -0.05 * k, 0.0])
        filter.measure(Measurement(k * 10**8, "fix", Position(place, np.zeros(3)), np.eye(3) * 0.01**2))
    at, _ = filter.estimate(50 * 10**8)
    np.testing.assert_allclose(at.position, [5.0, -2.5, 0.0], atol=0.1)
    np.testing.assert_allclose(at.velocity, [1.0, -0.5, 0.0], atol=0.05)


@pytest.mark.long
def test_alternative_headings_expire_in_motion_only() -> None:
    rng, still = np.random.default_rng(0), np.array([0.0, 0.0, 9.80665])
    samples = [
        Sample(ns(0.05 * k), 4e-3 * rng.standard_normal(3), still + 0.05 * rng.standard_normal(3), NOISE)
        for k in range(600)
    ]
    node = first_node(samples[:20], Prior(heading=0.0, heading_sigma=0.05), 9.80665, at_rest=True)
    filter = ErrorStateFilter(FilterConfig(), node)
    for k in range(20, 600):
        filter.feel(samples[k])
        if k % 20 == 0:
            place = Position(0.03 * rng.standard_normal(3), np.zeros(3))
            filter.measure(Measurement(samples[k].time, "fix", place, np.eye(3) * 0.03**2))
    resting = filter._newest()
    assert resting.moving < ns(1.0)
    assert sum(h.against for h in resting.hypotheses) == 11
    assert not any(h.against for h in reduced(resting.hypotheses, ns(21.0)))

    made = Made()
    moving = made.filter()
    made.fed(moving, made.fixes)
    assert moving._newest().moving > ns(3.0)


@pytest.mark.parametrize("heading", [0.0, None])
def test_restored_filter_continues_bit_for_bit(heading: float | None) -> None:
    made = Made(3.0)
    one = made.filter(heading=heading)
    half = 70
    for k in range(25, half):
        one.feel(made.samples[k])
        for fix in made.fixes:
            if made.samples[k - 1].time < fix.time <= made.samples[k].time:
                one.measure(fix)
    other = made.filter(heading=heading)
    other.restore(unpack_state(pack_state(one.snapshot())))
    for filter in (one, other):
        for k in range(half, len(made.samples)):
            filter.feel(made.samples[k])
            for fix in made.fixes:
                if made.samples[k - 5].time < fix.time <= made.samples[k - 4].time:
                    filter.measure(fix)
    assert bits(one) == bits(other)
    assert one.health["fix"].used == other.health["fix"].used
