"""The graphs that come with the project: each is sound, and those that need nothing run for a moment."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dataflow import run
from dataflow.graph import load_graph
from operators.weights import shipped

REPOSITORY = Path(__file__).resolve().parents[2]
GRAPHS = sorted((REPOSITORY / "graphs").rglob("*.yaml"))
DEMO = REPOSITORY / "graphs" / "simulated_robot.yaml"

SIMULATED = (
    "cloud", "dead_reckoning", "depth", "fusion", "landmarks", "localize", "mapping", "mono", "orientation", "places",
    "preprocessing", "redundant", "registration", "simulated_lidar", "simulated_stereo", "slam", "slam_lidar",
)  # fmt: skip

needs_weights = pytest.mark.skipif(
    not (shipped("detector.onnx").is_file() and shipped("segmenter.onnx").is_file()),
    reason="the networks are not in operators/weights",
)


def dataflow(*words: object) -> str:
    """What a command prints, in a process of its own from the root of the checkout."""
    command = [sys.executable, "-m", "dataflow.cli.main", *map(str, words)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("file", [g for g in GRAPHS if g.parent.name == "graphs"], ids=lambda file: file.stem)
def test_a_graph_passes_the_check(file: Path) -> None:
    assert load_graph(file).nodes


@pytest.mark.long
@pytest.mark.parametrize("name", SIMULATED)
def test_every_operator_of_a_graph_of_geometry_fires_on_the_simulators_first_moment(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(REPOSITORY)
    file = REPOSITORY / "graphs" / f"{name}.yaml"
    report = run(file, settings={"duration": "350ms"}).report
    uses = {operator: node.use for operator, node in load_graph(file).nodes.items()}
    idle = [operator for operator, counts in report.operators.items() if not counts.firings]
    assert [operator for operator in idle if not uses[operator].startswith("operators.evaluation:")] == []


def test_the_simulated_robot_is_the_one_of_the_recording() -> None:
    recorded = load_graph(REPOSITORY / "graphs" / "record_demo.yaml").nodes["robot"]
    assert load_graph(DEMO).nodes["robot"].params == recorded.params


@pytest.mark.long
@needs_weights
def test_the_demo_scores_everything_against_the_truth_and_its_recording_verifies(tmp_path: Path) -> None:
    file = tmp_path / "demo.mcap"
    words = ["recordings/demo.mcap", "--graph", DEMO, "--end", 1.5, "--one-process", "--record", file, "--json", "-q"]
    report = json.loads(dataflow("replay", *words))

    scores: dict[str, Any] = report["summaries"]
    assert scores["trajectory_score"]["matched"] == scores["detection_score"]["frames"] == 16
    assert scores["trajectory_score"]["ate_rmse_m"] < 0.02
    assert scores["detection_score"]["ap50"] > 0.5
    assert scores["segmentation_score"]["miou"] > 0.4
    assert report["streams"]["robot1/cloud/cloud"]["messages"] == 16
    assert json.loads(dataflow("verify", file, "--jobs", "1", "--json", "-q"))["identical"] is True


@pytest.mark.long
@needs_weights
def test_the_demo_runs_from_the_simulator_in_any_world() -> None:
    words = ["--set", "world=corridor", "--set", "seed=7", "--set", "duration=500ms", "--one-process", "--json", "-q"]
    report = json.loads(dataflow("run", DEMO, *words))

    assert report["operators"]["robot"]["firings"] == 50
    for operator in ("color", "depth", "cloud", "odometry", "detector", "segmenter"):
        emitted = 10 if operator in ("cloud", "odometry") else 5  # these give their status with each message
        assert report["operators"][operator] == report["operators"][operator] | {"emitted": emitted, "dropped": 0}
    assert report["summaries"]["segmentation_score"]["frames"] == 5
