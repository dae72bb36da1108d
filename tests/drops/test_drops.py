"""The losses that cost a figure are named; a set that is named is a smallest one; what cannot be told is refused."""

from __future__ import annotations

from pathlib import Path

import held_runs
import pytest
from held_runs import MS, STAMP

from dataflow.drops.losses import Loss
from dataflow.drops.search import Cost, Drops, DropsError, Worse
from dataflow.graph import load_text
from dataflow.recording import Recording
from dataflow.sync import FOREVER, TICK

STEPS = 200
FAULTS = held_runs.Faults(
    late={("turn", k): 60 for k in range(68, 80, 7)},
    still=[("odometry", 45, 55), ("odometry", 110, 120), ("smooth", 160, 175), ("beat", 100, 140)],
)
"""The large step 50 is dropped, and that of step 150 is made in the direction before turn 75."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return held_runs.recorded(held_runs.graph(STEPS), FAULTS, tmp_path_factory.mktemp("held") / "run.mcap")


def cost(run: Path, worse: str, budget: float = 600.0) -> Cost:
    with Recording(run) as recording:
        return Drops(recording, worse, budget=budget).find()


def test_the_drop_and_the_late_message_that_cost_the_estimate_are_named(run: Path) -> None:
    found = cost(run, "end_error_m > 5")

    assert found.named == [
        Loss(STAMP + 1000 * MS, "odometry", "step", "held/drive/step", "overflow", FOREVER),
        Loss(STAMP + 3000 * MS, "odometry", "turn", "held/drive/turn", "waited", STAMP + 3040 * MS),
    ]
    assert found.minimal
    assert found.losses > 20
    assert found.figures["score: end_error_m"] == pytest.approx(30.0, abs=0.5)
    assert found.undone["score: end_error_m"] < 0.5
    assert found.best["score: end_error_m"] == 0.0


def test_only_the_operators_between_the_losses_and_the_figure_are_replayed(run: Path) -> None:
    assert cost(run, "end_error_m > 5").operators == ("odometry", "smooth", "score")
    assert cost(run, "beats < 38").operators == ("beat",)


def test_beats_that_were_left_out_are_losses_too(run: Path) -> None:
    found = cost(run, "beats < 38")

    assert found.figures["beat: beats"] < 38
    assert found.undone["beat: beats"] == 38
    assert {loss.input for loss in found.named} == {TICK}
    assert len(found.named) == 38 - found.figures["beat: beats"]


def test_a_figure_is_called_by_its_name_its_beginning_or_its_operator() -> None:
    figures = {"track": {"ate_rmse_m": 0.1, "ate_max_m": 0.3, "rpe 1s": 2.0}, "other": {"recall": 0.5}}

    for text in (
        "ate_rmse_m > 0.05",
        "ate > 0.05",
        "track.ate_rmse_m > 0.05",
        "ate_max > 0.2",
        "rpe_1s == 2",
        "rpe == 2",
    ):
        worse = Worse(text, figures)
        assert worse.operators == ["track"]
        assert worse.is_true(figures)
    assert Worse("ate > 1 or recall < 1", figures).values(figures) == {"track: ate_rmse_m": 0.1, "other: recall": 0.5}
    assert not Worse("recall < 0.4", figures).is_true(figures)


@pytest.mark.parametrize(
    ("worse", "problem"),
    [
        ("end_error_m > 50", "the recorded figures are not end_error_m > 50: {'score: end_error_m': 30"),
        ("turns > 0", "losses undone it is turns > 0 still: {'score: turns': "),
        ("error > 50", "no figure error; there are: beats, end_error_m, turns, worst_error_m"),
        ("end_error_m > 'a'", "TypeError"),
        ("1 > 0", "no figure ; there are"),
    ],
)
def test_what_cannot_be_found_is_refused(run: Path, worse: str, problem: str) -> None:
    with pytest.raises(DropsError) as caught:
        cost(run, worse)

    assert problem in str(caught.value)


def test_other_code_is_no_base_for_a_comparison(run: Path) -> None:
    text = held_runs.TEXT.format(steps=STEPS, score="Score")
    other = load_text(text.replace("held_runs:Smooth", "held_runs:HalfSmooth"))

    with Recording(run) as recording, pytest.raises(DropsError, match="smooth has other firings from stamp"):
        Drops(recording, "end_error_m > 5", other).find()


def test_a_figure_that_changes_by_itself_is_refused(run: Path) -> None:
    chancy = held_runs.graph(STEPS, "Chancy")

    with Recording(run) as recording, pytest.raises(DropsError, match="the figures change by themselves"):
        Drops(recording, "end_error_m > 5", chancy).find()


def test_a_set_that_the_time_did_not_suffice_to_reduce_is_not_called_a_smallest(run: Path) -> None:
    found = cost(run, "end_error_m > 5", budget=0.0)

    assert not found.minimal
    assert found.undone["score: end_error_m"] < 5
