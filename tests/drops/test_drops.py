"""The losses that cost a figure are named; a set that is named is a smallest one; what cannot be told is refused."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import held_runs
import pytest
from held_runs import MS, STAMP

from dataflow.drops import player as player_module
from dataflow.drops.branch import Branch, Figures
from dataflow.drops.losses import Loss, bursts_of
from dataflow.drops.player import PlayedCalls, Player, ReplayedFirings
from dataflow.drops.search import Cost, Drops, DropsError, FailureCondition
from dataflow.graph import Graph, load_text
from dataflow.messages import FeatureVector, Message
from dataflow.recording import Recording
from dataflow.records.firing import FiringRecord
from dataflow.records.reading import FiringLog
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.sync import FOREVER, TICK, Entry, Firing

STEPS = 200
FAULTS = held_runs.Faults(
    late={("turn", k): 60 for k in range(68, 80, 7)},
    still=[("odometry", 45, 55), ("odometry", 110, 120), ("smooth", 160, 175), ("beat", 100, 140)],
)
"""The large step 50 is dropped, and that of step 150 is made in the direction before turn 75."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return held_runs.recorded(held_runs.graph(STEPS), FAULTS, tmp_path_factory.mktemp("held") / "run.mcap")


def cost(run: Path, worse: str = "end_error_m > 5", graph: Graph | None = None, *, budget: float = 600.0) -> Cost:
    with Recording(run) as recording:
        return Drops(recording, worse, graph, budget=budget).find()


def test_drop_and_late_message_that_cost_the_figure_are_named(run: Path) -> None:
    found = cost(run)

    assert found.named == [
        Loss(STAMP + 1000 * MS, "odometry", "step", "held/drive/step", "overflow", FOREVER),
        Loss(STAMP + 3000 * MS, "odometry", "turn", "held/drive/turn", "waited", STAMP + 3040 * MS),
    ]
    assert found.minimal
    assert found.losses > 20
    assert sum(found.reasons.values()) == found.losses
    assert {"overflow", "waited"} <= found.reasons.keys()
    assert found.figures["score: end_error_m"] == pytest.approx(30.0, abs=0.5)
    assert found.undone["score: end_error_m"] < 0.5
    assert found.best["score: end_error_m"] == 0.0
    assert [one["until"] for one in found.as_json()["named"]] == [None, STAMP + 3040 * MS]


def test_successive_losses_are_one_burst_and_tried_together(run: Path) -> None:
    sent = {name: [((0, k), 10 * k) for k in range(20)] for name in ("a", "b")}

    def lost(operator: str, stream: str, *numbers: int) -> list[Loss]:
        return [Loss(10 * k, operator, "in", stream, "overflow") for k in numbers]

    stop = sorted(lost("o", "a", 3, 4, 5, 6) + lost("o", "b", 5, 6, 7))
    others = lost("o", "a", 9), lost("o", "a", 11), lost("p", "a", 4)
    found = bursts_of(sorted(sum(others, stop)), sent)
    assert sorted(map(sorted, found)) == sorted([stop, *others])
    assert found[0][0].stamp == 30

    held = cost(run, budget=0.0)
    assert not held.minimal
    assert held.undone["score: end_error_m"] < 5
    assert held.replays == 3  # as it was, with all losses undone, and that by operators made anew


def test_nothing_is_replayed_twice_and_the_longest_burst_is_tried_first(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[frozenset[Loss]] = []
    replay = Branch.replay

    def counted(branch: Branch, undone: Collection[Loss] = ()) -> Figures:
        asked.append(frozenset(undone))
        return replay(branch, undone)

    monkeypatch.setattr(Branch, "replay", counted)
    found = cost(run)

    *before, last = asked
    assert len({*before}) == len(before) == found.replays - 1
    assert last == {*found.named}  # by operators made anew
    assert len(before[1]) == found.losses
    assert {loss.operator for loss in before[2]} == {"smooth"}  # which stood still for longest


@pytest.mark.long
def test_only_the_operators_between_the_losses_and_the_figure_are_replayed(run: Path) -> None:
    assert cost(run).operators == ("odometry", "smooth", "score")
    assert cost(run, "beats < 38").operators == ("beat",)


def test_beats_that_were_left_out_are_losses_too(run: Path) -> None:
    found = cost(run, "beats < 38")

    assert found.figures["beat: beats"] < 38
    assert found.undone["beat: beats"] == 38
    assert {loss.input for loss in found.named} == {TICK}
    assert len(found.named) == 38 - found.figures["beat: beats"]


def test_figure_is_found_by_name_prefix_or_operator() -> None:
    figures = {"track": {"ate_rmse_m": 0.1, "ate_max_m": 0.3, "rpe 1s": 2.0}, "other": {"recall": 0.5}}

    texts = ("ate_rmse_m > 0.05", "ate > 0.05", "track.ate_rmse_m > 0.05", "ate_max > 0.2", "rpe_1s == 2", "rpe == 2")
    for text in texts:
        worse = FailureCondition(text, figures)
        assert worse.operators == ["track"]
        assert worse.is_true(figures)
    assert FailureCondition("ate > 1 or recall < 1", figures).values(figures) == {
        "track: ate_rmse_m": 0.1,
        "other: recall": 0.5,
    }
    assert not FailureCondition("recall < 0.4", figures).is_true(figures)


@pytest.mark.parametrize(
    ("text", "is_true"),
    [
        ("abs(end_error_m) > 1", True),
        ("max(end_error_m, recall) > 1", False),
        ("min(end_error_m, recall) < -1", True),
        ("round(recall, 1) == 0.5 and sum((recall, recall)) == 1", True),
        ("round > 2", True),  # a figure that has the name of a function
    ],
)
def test_an_expression_may_call_functions(text: str, is_true: bool) -> None:
    figures = {"track": {"end_error_m": -1.5, "recall": 0.5, "round_trip_ms": 3.0}}

    assert FailureCondition(text, figures).is_true(figures) == is_true


def test_unknown_functions_are_refused() -> None:
    with pytest.raises(DropsError, match="no function open, sqrt; there are: abs, min, max, round, sum, len, any, all"):
        FailureCondition("sqrt(recall) > open('x')", {"track": {"recall": 0.5}})


@pytest.mark.parametrize(
    ("worse", "problem"),
    [
        ("end_error_m > 50", "the recorded figures are not end_error_m > 50: score: end_error_m 30"),
        ("turns > 0", "losses undone it is turns > 0 still: score: turns "),
        ("error > 50", "no figure error; there are: beats, end_error_m, turns, worst_error_m"),
        ("end_error_m > 'a'", "TypeError"),
        ("1 > 0", "no figure ; there are"),
    ],
)
def test_unmet_or_unknown_drop_condition_is_refused(run: Path, worse: str, problem: str) -> None:
    with pytest.raises(DropsError) as caught:
        cost(run, worse)

    assert problem in str(caught.value)


def test_changed_code_is_refused(run: Path) -> None:
    text = held_runs.TEXT.format(steps=STEPS, score="Score")
    other = load_text(text.replace("held_runs:Smooth", "held_runs:HalfSmooth"))

    with pytest.raises(DropsError, match="smooth has other firings from stamp"):
        cost(run, graph=other)


def test_a_run_with_a_restart_is_refused_with_its_place(tmp_path: Path) -> None:
    text = held_runs.TEXT.format(steps=STEPS, score="Score").replace("held_runs:Smooth", "held_runs:Brittle")
    brittle = load_text(text.replace("live: {queue: newest, size: 4}", "live: {queue: newest, restart: {max: 1}}"))
    run = held_runs.recorded(brittle, FAULTS, tmp_path / "run.mcap")

    with pytest.raises(DropsError, match=f"^smooth: it was restarted behind its call at stamp {STAMP + 2000 * MS}"):
        cost(run)


def test_a_figure_that_changes_by_itself_is_refused(run: Path) -> None:
    with pytest.raises(DropsError, match="the figures change by themselves"):
        cost(run, graph=held_runs.graph(STEPS, "Chancy"))


@pytest.mark.long
@pytest.mark.parametrize("score", ["Undecided", "Silent"])
def test_a_figure_that_is_missing_or_nan_heals_nothing(run: Path, score: str) -> None:
    found = cost(run, graph=held_runs.graph(STEPS, score))

    assert [loss.stamp for loss in found.named] == [STAMP + 1000 * MS, STAMP + 3000 * MS]


def test_killed_run_has_no_figures(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ordered = FiringLog.ordered
    unfinished = "dataflow.records.reading.FiringLog.ordered"
    monkeypatch.setattr(unfinished, lambda log, node: (r for r in ordered(log, node) if r.kind != "finish"))

    with pytest.raises(DropsError, match=r"no figures are recorded: the run was ended before"):
        cost(run)


def _firing(stamp: int, value: float, port: str) -> Firing:
    message = held_runs.vector(stamp, value)
    return Firing(stamp, "fire", inputs={port: Entry(stamp, message, 0, 0, message.digest(), "held/drive/step")})


def test_stateless_operator_has_recorded_parameters_in_each_replay() -> None:
    graph = _graph("Scaled", "at: drive/step")
    change = FiringRecord("it", 0, 2, "param", 10, detail={"name": "gain", "value": 2.0})
    player = Player(graph.nodes["it"], graph, 1, [FiringRecord("it", 0, 1, "fire", 10), change])

    replays = [
        [_value(PlayedCalls(player).process(_firing(stamp, value, "at"))) for stamp in (10, 20)] for value in (1.0, 3.0)
    ]

    assert replays == [[1.0, 2.0], [3.0, 6.0]]


def test_inputs_before_a_kept_state_are_released(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(player_module, "SPACING", 0.0)
    given = ReplayedFirings()
    graph = _graph("Count", "step: drive/step")
    player = Player(graph.nodes["it"], graph, 1, ())
    for stamp in (10, 20, 30):
        player.process(given, _firing(stamp, 1.0, "step"))
    assert [firing.inputs for firing in given.firings] == [{}, {}, {}]
    assert given.nbytes == 0

    monkeypatch.setattr(player_module, "SPACING", 1e9)
    monkeypatch.setattr(player_module, "MOST_GIVEN", 1)
    with pytest.raises(ReplayError, match="it would have to be brought back over more than"):
        player.process(given, _firing(40, 1.0, "step"))


def _graph(operator: str, inputs: str) -> Graph:
    text = "graph: held\noperators:\n  drive: {use: 'held_runs:Drive'}\n"
    return load_text(f"{text}  it: {{use: 'held_runs:{operator}', inputs: {{{inputs}}}}}\n")


def _value(made: Mapping[str, Message]) -> float:
    (message,) = made.values()
    assert isinstance(message, FeatureVector)
    return float(message.vectors[0, 0])
