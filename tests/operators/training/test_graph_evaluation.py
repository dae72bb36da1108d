"""`dataflow evaluate graph`: one table of a graph's figures, and data given by a word."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from operators.training.evaluation import evaluate
from operators.training.graph_evaluation import data_settings, recording_in

GRAPH = """
graph: scored
params: {frames: 4}
operators:
  camera:
    use: operators.sources:SyntheticRgbd
    params: {frames: "${frames}"}
  odometry:
    use: operators.odometry:VisualOdometry
    inputs:
      image: camera/image
      depth: camera/depth
      image_info: camera/image_info
      depth_info: camera/depth_info
  metrics:
    use: operators.evaluation:TrajectoryMetrics
    inputs: {estimate: odometry/odometry, ground_truth: camera/ground_truth}
"""


@pytest.mark.long
def test_a_graph_is_run_and_its_figures_are_printed(tmp_path: Path) -> None:
    (tmp_path / "scored.yaml").write_text(GRAPH)
    ran = CliRunner().invoke(evaluate, ["graph", str(tmp_path / "scored.yaml"), "--set", "frames=5", "--json"])
    assert ran.exit_code == 0, ran.output
    figures = json.loads(ran.stdout)["figures"]
    assert list(figures) == ["metrics"]  # the odometry counts, too, and that is no score
    assert figures["metrics"]["matched"] == 5


@pytest.mark.long
def test_a_recording_takes_the_place_of_the_sources(tmp_path: Path) -> None:
    (tmp_path / "scored.yaml").write_text(GRAPH)
    recording = tmp_path / "four.mcap"
    ran = CliRunner().invoke(app, ["run", str(tmp_path / "scored.yaml"), "--record", str(recording), "-q"])
    assert ran.exit_code == 0, ran.output
    words = ["graph", str(tmp_path / "scored.yaml"), "--data", str(recording), "--all", "--json"]
    ran = CliRunner().invoke(evaluate, words)
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    assert told["recording"] == str(recording)
    assert told["figures"]["metrics"]["matched"] == 4
    assert told["figures"]["odometry"]["tracking"] == 4


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (["here"], (None, ["here"])),
        (["path=a.mcap"], (None, ["path=a.mcap"])),  # said to be the parameter's
    ],
)
def test_only_a_recording_by_itself_is_replayed(data: list[str], found: tuple[None, list[str]]) -> None:
    assert recording_in({"path": 1}, data) == found
    assert recording_in({"recording": 1}, ["a.mcap"]) == (None, ["a.mcap"])
    with pytest.raises(FileNotFoundError, match=r"no recording 'nowhere/a\.mcap' \(looked for"):
        recording_in({}, ["nowhere/a.mcap"])
    with pytest.raises(ValueError, match="names 2 recordings"):
        recording_in({}, ["a.mcap", "b.mcap"])


@pytest.mark.parametrize(
    ("parameters", "data", "found"),
    [
        ({"path": 1, "seed": 2}, ["here"], ["path=here"]),
        ({"data": 1, "model": 2}, ["here", "model=x=y.onnx"], ["data=here", "model=x=y.onnx"]),
        ({"path": 1}, ["a=b"], ["path=a=b"]),  # a folder with a strange name
    ],
)
def test_data_is_given_to_the_parameter_that_is_for_it(
    parameters: dict[str, int], data: list[str], found: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a=b").mkdir()
    monkeypatch.chdir(tmp_path)
    assert data_settings(parameters, data) == found


def test_data_for_a_parameter_that_a_graph_has_not_is_no_folder_of_that_name() -> None:
    with pytest.raises(ValueError, match=r"no parameter 'modle'; its parameters: data, model"):
        data_settings({"data": 1, "model": 2}, ["modle=x.onnx"])


def test_a_graph_that_comes_with_dataflow_is_called_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[list[str]] = []

    def run(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        called.append(words)
        return subprocess.CompletedProcess(words, 0, json.dumps({"summaries": {"metrics": {"matched": 5}}}))

    monkeypatch.setattr(subprocess, "run", run)
    ran = CliRunner().invoke(evaluate, ["graph", "synthetic_rgbd", "--json"])

    assert ran.exit_code == 0, ran.output
    assert called[0][4].endswith("graphs/synthetic_rgbd.yaml")


@pytest.mark.long
@pytest.mark.parametrize(
    ("graph", "parameter", "others"),
    [
        ("perception_kitti", "car", ["detector=simulated"]),  # its own detector lacks its file there, too
        ("slam_folder", "camera", []),
    ],
)
def test_data_that_is_not_there_is_one_line(
    graph: str, parameter: str, others: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    settings = [word for each in ["data=/nowhere", *others] for word in ("--set", each)]
    ran = CliRunner().invoke(evaluate, ["graph", graph, *settings])
    told = capfd.readouterr().err
    told = told[told.index("error: ") :]  # behind the warning of networks that were trained in simulation

    assert ran.exit_code == 1
    assert told.startswith(f"error: operator '{parameter}' failed in setup(): SourceError: no ")
    assert told.endswith(f"name another with --set {parameter}.path=...\n")
    assert "Traceback" not in told


def test_a_graph_without_data_is_named() -> None:
    with pytest.raises(ValueError, match=r"none of data, path.*its parameters: seed"):
        data_settings({"seed": 1}, ["here"])
    ran = CliRunner().invoke(evaluate, ["graph", "nowhere.yaml"])
    assert ran.exit_code == 2
    assert "no graph file 'nowhere.yaml'" in ran.stderr.replace("\n", " ")
