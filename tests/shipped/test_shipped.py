"""The graphs and the recording that come with dataflow are found by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_commands import call

from dataflow import shipped
from dataflow.cli.commands import demo as demo_command
from dataflow.graph import load_graph


def test_every_graph_of_the_repository_is_listed_with_its_purpose(repository: Path) -> None:
    found = {graph.name: graph for graph in shipped.graphs()}

    assert {"simulated_robot", "synthetic_rgbd", "chaos/robot"} <= set(found)
    assert "chaos/plan" not in found  # a fault plan, not a graph
    assert all(graph.about and graph.about[0].endswith((".", ",", "pixel,")) for graph in found.values())
    assert found["stereo"].path == repository / "graphs" / "stereo.yaml"
    listed = json.loads(call("graphs", "--json").stdout)
    assert [graph["name"] for graph in listed] == list(found)


@pytest.mark.parametrize("word", ["synthetic_rgbd", "synthetic_rgbd.yaml", "graphs/synthetic_rgbd.yaml"])
def test_a_graph_is_named_by_its_short_name_from_any_folder(tmp_path: Path, monkeypatch, word: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert "synthetic_rgbd.yaml: 4 operators" in call("check", word).stdout


def test_a_file_of_that_name_comes_first(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "synthetic_rgbd.yaml").write_text("graph: mine\n")
    assert "the graph has no operators" in call("check", "synthetic_rgbd.yaml", code=1).stdout


def test_unknown_name_refers_to_the_list_of_graphs(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "dataflow graphs lists" in call("check", "nothing.yaml", code=2).stderr
    assert "did you mean 'synthetic_rgbd'?" in call("graphs", "synth_rgbd", code=2).stderr


def test_a_printed_graph_is_one_to_begin_from(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text(call("graphs", "synthetic_rgbd").stdout)
    assert load_graph(mine).name == "synthetic_rgbd"


def test_the_demo_has_its_graph_and_its_recording() -> None:
    assert shipped.graph(demo_command.GRAPH) is not None
    found = shipped.recording(demo_command.RECORDING)
    assert found is not None
    assert found.stat().st_size < 15_000_000
    assert shipped.recording("../README") is None


def test_demo_opens_window_or_writes_file_of_free_name(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DISPLAY", ":7")
    outputs = demo_command._outputs()
    assert (outputs.live_view, outputs.view_file) == ("spawn", None)
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert demo_command._outputs().view_file == Path("dataflow-demo.rrd")
    Path("dataflow-demo.rrd").touch()
    assert demo_command._outputs().view_file == Path("dataflow-demo-2.rrd")


def test_commands_without_shipped_files_suggest_reinstalling(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(shipped, "folder", lambda name: tmp_path / name)
    assert "install robot-dataflow again" in call("demo", code=2).stderr
    assert "install robot-dataflow again" in call("graphs", code=2).stderr


@pytest.mark.long
def test_the_demo_runs_to_its_end_without_a_display(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)

    said = call("demo", "--seconds", 1, "-q")

    told = said.stdout
    assert "plays 1.00 s of a drive as fast as this machine computes it" in " ".join(said.stderr.split())
    assert "perception  complete" in told
    assert "rerun dataflow-demo.rrd" in told
    assert (tmp_path / "dataflow-demo.rrd").stat().st_size > 100_000
