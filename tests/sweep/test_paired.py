"""Paired comparison: small differences between hard and easy recordings are found, and none where there is none."""

from __future__ import annotations

import math
import tracemalloc
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dataflow.sweep.paired import ALPHA, compared, least_p, needed, unlike

if TYPE_CHECKING:
    from scipy.stats import binom, mannwhitneyu, wilcoxon


def worlds(rng: np.random.Generator, gain: float, count: int = 40) -> dict[str, tuple[float, float]]:
    """Scores of two versions: worlds differ by 10 points, one world's two runs by half a point."""
    hard = rng.normal(60, 10, count)
    noise = rng.normal(0, 0.5, (2, count))
    return {f"w{k}": (hard[k] + noise[0, k], hard[k] + gain + noise[1, k]) for k in range(count)}


def test_half_a_point_is_found_in_pairs_and_not_between_means() -> None:
    rng = np.random.default_rng(1)
    found = unpaired = 0
    for _ in range(40):
        pairs = worlds(rng, 0.5)
        (one,) = compared({"detector: precision": pairs})
        found += one.differs
        unpaired += mannwhitneyu(*np.array(list(pairs.values())).T).pvalue < 0.05
    assert found >= 38
    assert unpaired <= 4


@pytest.mark.long
def test_equal_versions_differ_no_more_often_than_the_level_allows() -> None:
    rng = np.random.default_rng(2)
    alarms = sum(compared({"detector: precision": worlds(rng, 0.0)})[0].differs for _ in range(200))
    assert alarms <= binom.ppf(0.99, 200, 0.05)


def test_p_is_that_of_scipy_and_the_interval_holds_the_difference() -> None:
    pairs = worlds(np.random.default_rng(3), 0.3)
    (one,) = compared({"x: recall": pairs})
    differences = np.diff(np.array(list(pairs.values()))).ravel()
    assert one.p == one.adjusted == pytest.approx(wilcoxon(differences).pvalue)
    assert one.difference == pytest.approx(differences.mean())
    assert one.low is not None
    assert one.high is not None
    assert one.low < one.difference < one.high


def test_many_figures_are_judged_together() -> None:
    rng = np.random.default_rng(4)
    figures = {f"x: figure {k}": worlds(rng, 0.0) for k in range(100)} | {"x: recall": worlds(rng, 1.0)}
    assert [one.figure for one in compared(figures) if one.differs] == ["x: recall"]


def test_recordings_are_sorted_by_their_share_of_the_difference() -> None:
    changes = {f"r{k}": change for k, change in enumerate((0.3, 0.2, 0.0, -0.1))}
    better = {name: (0.5, 0.5 + change) for name, change in changes.items()}
    worse = {name: (b, a) for name, (a, b) in better.items()}
    for figure in ("judge: recall", "judge: rmse", "judge: count"):
        for pairs in (better, worse):
            assert compared({figure: pairs})[0].most_changed == ["r0", "r1", "r2", "r3"]


def test_the_worst_recordings_for_b_come_first() -> None:
    pairs = {"one": (1.0, 2.0), "two": (1.0, 0.5), "three": (1.0, 1.0)}
    falling, rising, open_ = ["one", "three", "two"], ["two", "three", "one"], ["one", "two", "three"]
    names = {
        "o: rmse": falling,
        "o_error: ate_rmse_m": falling,
        "o: recall": rising,
        "o: worst_class_ap50": rising,
        "o: n": open_,
        "recall_error: frames": open_,  # the words of an operator's name do not count
    }
    assert {name: [n for n, _ in compared({name: pairs})[0].recordings] for name in names} == names


def test_figures_that_are_equal_do_not_differ() -> None:
    (one,) = compared({"x: n": {"a": (1.0, 1.0), "b": (2.0, 2.0)}})
    assert (one.p, one.difference, one.differs) == (1.0, 0.0, False)


@pytest.mark.parametrize(("count", "has"), [(1, False), (2, False), (3, True)])
def test_an_interval_needs_three_recordings(count: int, has: bool) -> None:
    (one,) = compared({"x: n": {f"r{k}": (0.0, -3.5 - k) for k in range(count)}})
    assert (one.low is not None, one.high is not None) == (has, has)


@pytest.mark.parametrize(("figures", "recordings"), [(1, 6), (2, 7), (10, 9)])
def test_the_least_p_that_recordings_can_have_goes_by_the_number_of_figures(figures: int, recordings: int) -> None:
    worse = {f"x: figure {k}": {f"r{n}": (0.0, -float(1 + n)) for n in range(recordings)} for k in range(figures)}
    assert needed(figures) == recordings
    assert compared(worse)[0].adjusted == pytest.approx(least_p(recordings, figures))
    assert all(one.differs for one in compared(worse))
    assert least_p(recordings - 1, figures) >= ALPHA


def test_copies_of_a_recording_count_once() -> None:
    def tasks(side: str) -> list[Any]:
        named = {"a": "1", "copy": "1", "b": "2"}
        return [SimpleNamespace(source=SimpleNamespace(name=n, digest=d), side=side) for n, d in named.items()]

    first, second, copies = unlike(tasks("A"), tasks("B"))

    assert [(task.source.name, other.source.name) for task, other in zip(first, second, strict=True)] == [
        ("a", "a"),
        ("b", "b"),
    ]
    assert copies == {"copy": "a"}


def test_recordings_without_a_number_are_left_out_and_named() -> None:
    pairs = worlds(np.random.default_rng(5), 1.0)
    broken = {**pairs, "nan": (1.0, math.nan), "inf": (math.inf, 1.0)}
    one, other = compared({"x: recall": broken, "x: iou": pairs})
    assert {one.p, other.p} == {compared({"x: recall": pairs})[0].p}
    assert {one.left_out, other.left_out} == {("nan", "inf"), ()}
    assert compared({"x: recall": {"a": (1.0, math.nan)}}) == []


@pytest.mark.long
def test_many_recordings_take_memory_for_a_few() -> None:
    pairs = {f"w{k}": (0.0, float(k % 3)) for k in range(20_000)}
    tracemalloc.start()
    compared({"x: n": pairs})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6  # 10,000 draws of all of them at once are 1.6 GB
