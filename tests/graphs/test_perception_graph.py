"""The perception graph on the bundled recording: sensors in, a scene graph out, the same again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from operators.scene.commands import scene
from operators.weights import shipped

REPOSITORY = Path(__file__).resolve().parents[2]

needs_weights = pytest.mark.skipif(
    not (shipped("detector.onnx").is_file() and shipped("segmenter.onnx").is_file()),
    reason="the networks are not in operators/weights",
)


def run(*words: object) -> str:
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return done.stdout


@needs_weights
def test_the_recording_becomes_a_scene_graph_that_verifies_and_answers(tmp_path: Path) -> None:
    file, graph = tmp_path / "room.mcap", REPOSITORY / "graphs" / "perception.yaml"
    demo = REPOSITORY / "recordings" / "demo.mcap"
    run("replay", demo, "--graph", graph, "--end", 1.2, "--one-process", "--record", file, "--json", "-q")

    assert json.loads(run("verify", file, "--one-process", "--json", "-q"))["identical"] is True
    shown = json.loads(CliRunner().invoke(scene, [str(file), "--json"]).stdout)
    assert {n["name"] for n in shown["nodes"]} >= {"room", "self", "floor", "bin 1"}
    asked = CliRunner().invoke(scene, [str(file), "--query", "bin on floor"])
    assert asked.exit_code == 0
    assert "on floor" in asked.output
