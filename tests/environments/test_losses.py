"""Losses that cost a figure, between operators in several environments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import held_runs
import pytest
from made_environments import environment, packages

from dataflow.drops.search import Cost, Drops
from dataflow.graph import Graph, load_text
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import ReplayError

STEPS = 200
FAULTS = held_runs.Faults(
    late={("turn", k): 60 for k in range(68, 80, 7)}, still=[("odometry", 45, 55), ("smooth", 160, 175)]
)


def graph(**params: object) -> Graph:
    text = held_runs.TEXT.format(steps=STEPS, score="Score").replace("held_runs:Odometry", "tuned_operators:Tuned")
    return load_text(
        text.replace(
            "    live: {queue: newest, size: 4, wait: 10ms}",
            f"    params: {params}\n    live: {{queue: newest, size: 4, wait: 10ms}}",
        )
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A live run with an operator that has a package of an environment, and the folder of that."""
    folder = tmp_path_factory.mktemp("held")
    there = environment(folder / "one", "1.0", 1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(packages(there)))
        held_runs.recorded(graph(), FAULTS, folder / "run.mcap")
    return folder / "run.mcap", str(there)


def cost(run: Path, given: Graph) -> Cost:
    with Recording(run) as recording:
        return Drops(recording, "end_error_m > 5", given, budget=100.0).find()


def within(given: Graph, env: str) -> Graph:
    return replace(given, nodes={**given.nodes, "odometry": replace(given.nodes["odometry"], env=env)})


@pytest.mark.long
def test_losses_are_named_between_operators_of_several_environments(run: tuple[Path, str]) -> None:
    path, env = run
    found = cost(path, within(graph(), env))

    assert found.minimal
    assert found.operators == ("odometry", "smooth", "score")
    assert [(loss.operator, loss.input, loss.reason) for loss in found.named] == [
        ("odometry", "step", "overflow"),
        ("odometry", "turn", "waited"),
    ]
    assert found.undone["score: end_error_m"] < 0.5


@pytest.mark.long
@pytest.mark.parametrize(
    ("params", "told"),
    [
        ({"fails_at": 600}, r"failed in [^:]*: ValueError: not this one"),
        ({"fails_at": 600, "dies": True}, r"odometry: its process in .*one ended \(7\)"),
    ],
)
def test_an_operator_that_fails_in_its_environment_is_named(
    params: dict[str, object], told: str, run: tuple[Path, str]
) -> None:
    path, env = run
    with pytest.raises((RuntimeError, ReplayError), match=told):
        cost(path, within(graph(**params), env))
