"""Graphs that are built, run, recorded, replayed and verified in Python, without YAML and without processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from watched import Broken, Camera, Counting, Interrupting, Judge, Photometer

import dataflow
from dataflow.graph import GraphError, load_graph
from dataflow.supervision.core.report import RunFailed, Status

FINDS_OPERATORS = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
"""The environment of programs that import `watched`."""


def watch(**camera: object) -> dataflow.Graph:
    graph = dataflow.Graph("watch", namespace="shop", seed=7)
    graph.add("camera", Camera, **camera).add("meter", Photometer, gain=2.0).add("judge", Judge)
    return graph.connect("meter", image="camera/image").connect(
        "judge", brightness="meter/brightness", exposure="camera/exposure"
    )


def test_a_graph_runs_and_reports(tmp_path: Path) -> None:
    run = watch().run(record=tmp_path / "run.mcap")

    assert run.summaries == {"judge": {"alarms": 4}}
    assert run.report.operators["meter"].firings == 6
    assert run.drops == {"judge": (("brightness", "no_sample", 1),)}
    assert "4 alarms" not in repr(run)
    assert ">judge<" in run._repr_html_()
    with run.open() as recording:
        assert recording["brightness"]["value"].round(1).tolist() == [0, 80, 160, 240, 320, 400]
        assert [alarm.text for alarm in recording["alarm"]] == [f"exposure {i}" for i in (1, 3, 3, 5)]
        assert recording.graph is not None
        assert recording.graph.name == "watch"


def test_run_in_this_process_equals_one_in_processes(tmp_path: Path) -> None:
    here = watch().run(record=tmp_path / "here.mcap")
    there = dataflow.launch(watch(), record=tmp_path / "there.mcap", placement="process_each")

    assert here.digests() == there.digests()
    assert here.report.drops == there.report.drops
    assert here.summaries == there.summaries


@pytest.mark.long
def test_a_recording_made_here_replays_and_verifies_in_processes(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    run = watch().run(record=path)

    found = dataflow.verify(path)
    assert found.identical
    assert found.report.messages == 6 + 4
    assert "identical" in found._repr_html_()
    assert dataflow.replay(path).digests() == run.digests()
    command = [sys.executable, "-m", "dataflow.cli.main", "replay", str(path), "--one-process", "--json", "--quiet"]
    shown = subprocess.run(command, env=FINDS_OPERATORS, capture_output=True, text=True, check=True, timeout=60)
    streams = json.loads(shown.stdout)["streams"]
    assert {name: values["digest"] for name, values in streams.items()} == run.digests()


def test_a_replay_goes_through_another_graph_and_only_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    watch().run(record=path)
    other = dataflow.Graph("other", namespace="shop").add("camera", Camera).add("meter", Photometer, gain=1.0)
    other.connect("meter", image="camera/image")

    dataflow.replay(path, graph=other, end=0.25, record=tmp_path / "other.mcap")
    with dataflow.open(tmp_path / "other.mcap") as recording:
        assert recording["brightness"]["value"].round(1).tolist() == [0, 40, 80]


@pytest.mark.long
def test_a_changed_operator_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    watch().run(record=path)
    with dataflow.open(path) as recording:
        assert recording.graph is not None
    changed = watch()
    changed._operators["meter"]["params"] = {"gain": 3.0}

    assert dataflow.verify(path, graph=changed).culprits == ("meter",)


def test_the_graph_is_a_yaml_text_that_loads_as_the_same_graph(tmp_path: Path) -> None:
    graph = watch(frames=np.int64(3)).configure("judge", process="slow", live={"queue": "newest"})
    graph.record("camera/**", exclude=["camera/image"])

    loaded = load_graph(graph.save(tmp_path / "watch.yaml"))
    built = graph.build()
    assert loaded.nodes["camera"].params == built.nodes["camera"].params == {"frames": 3}
    assert loaded.streams == built.streams
    assert loaded.record.streams == ("shop/camera/exposure",)
    assert built.nodes["judge"].live.queue == "newest"
    assert "judge" in graph._repr_html_()


def test_a_graph_file_runs_here_with_settings(tmp_path: Path) -> None:
    file = watch().save(tmp_path / "watch.yaml")
    run = dataflow.run(file, settings={"camera.frames": 2})

    assert run.report.streams["shop/meter/brightness"][0] == 2
    with pytest.raises(ValueError, match="not recorded"):
        run.open()
    with pytest.raises(ValueError, match=r"Graph\.add"):
        dataflow.run(watch(), settings={"camera.frames": 2})


def test_mistakes_are_those_of_the_graph_language() -> None:
    with pytest.raises(GraphError, match=r"(?s)camera/imago.*did you mean 'camera/image'"):
        watch().connect("meter", image="camera/imago").run()
    with pytest.raises(GraphError, match="frame"):
        dataflow.Graph().add("camera", Camera, frame=3).build()
    with pytest.raises(ValueError, match="no operator 'metre': did you mean 'meter'"):
        watch().connect("metre", image="camera/image")
    with pytest.raises(ValueError, match="there is an operator 'meter' already"):
        watch().add("meter", Photometer)
    with pytest.raises(TypeError, match=r"parameters are keywords"):
        dataflow.Graph().add("camera", Camera())
    with pytest.raises(TypeError, match="has no place in a graph"):
        dataflow.Graph().add("camera", Camera, frames=object())


def test_a_class_inside_a_function_is_refused_before_anything_runs() -> None:
    class Inner(Photometer):
        """Stands where nobody can import it."""

    with pytest.raises(ValueError, match="move it to the top level"):
        dataflow.Graph().add("inner", Inner)


def test_failing_operator_is_named_and_the_recording_keeps_earlier_messages(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    graph = dataflow.Graph("fails", namespace="shop").add("camera", Camera).add("broken", Broken)
    with pytest.raises(RunFailed, match="operator 'broken' failed in fire at stamp 300000000: ValueError") as caught:
        graph.connect("broken", image="camera/image").run(record=path)

    assert caught.value.operator == "broken"
    with dataflow.open(path) as recording:
        assert len(recording["image"]) == 3
        assert recording.metadata["dataflow:outcome"]["outcome"].startswith("failed: operator 'broken'")


def test_ctrl_c_ends_a_run_in_order_and_its_recording_verifies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    before = signal.getsignal(signal.SIGINT)
    graph = dataflow.Graph("stopped", namespace="shop").add("camera", Camera).add("counter", Interrupting)
    run = graph.connect("counter", image="camera/image").run(record=path)

    assert run.report.interrupted
    assert signal.getsignal(signal.SIGINT) is before
    with dataflow.open(path) as recording:
        assert recording["count"]["value"].tolist() == [1.0, 2.0, 3.0]
        assert recording.metadata["dataflow:outcome"]["outcome"] == "interrupted"
    monkeypatch.setattr(Interrupting, "process", Counting.process)
    assert dataflow.replay(path).report.streams["shop/counter/count"][0] == 3


def test_replay_from_the_middle_restores_the_state(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    graph = dataflow.Graph("count", namespace="shop").add("camera", Camera).add("counter", Counting)
    graph.connect("counter", image="camera/image").run(record=path)

    dataflow.replay(path, start=0.3, record=tmp_path / "rest.mcap")
    with dataflow.open(tmp_path / "rest.mcap") as recording:
        assert recording["count"]["value"].tolist() == [4.0, 5.0, 6.0]


def test_progress_is_reported_while_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dataflow.api.local.SHOW_EVERY", 0.0)
    seen: list[Status] = []
    watch().run(watch=seen.append)

    assert seen[-1].operators["camera"].firings == 6


NOTEBOOK = """
import numpy as np, dataflow
from dataflow.messages import Image, Number
from dataflow.operator import In, Operator, Out
from watched import Camera

class Contrast(Operator):
    image: In[Image] = In(doc="taken")
    contrast: Out[Number] = Out(doc="standard deviation")

    def process(self, image):
        return Number(stamp=image.stamp, value=float(image.data.std()) + self.rng.random())

graph = dataflow.Graph("cell").add("camera", Camera).add("contrast", Contrast).connect("contrast", image="camera/image")
run = graph.run(record="cell.mcap")
print(dataflow.verify("cell.mcap"), dataflow.replay("cell.mcap").digests() == run.digests())
try:
    dataflow.launch(graph)
except ValueError as error:
    print(error)
Contrast.process = lambda self, image: Number(stamp=image.stamp, value=0.0)
print(dataflow.verify("cell.mcap"))
"""


def test_an_operator_of_a_notebook_runs_replays_and_verifies_in_its_process(tmp_path: Path) -> None:
    command = [sys.executable, "-c", NOTEBOOK]
    done = subprocess.run(command, cwd=tmp_path, env=FINDS_OPERATORS, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        "<verification: identical, 6 messages> True",
        "contrast: defined in this program, where no other process finds them; use run()",
        "<verification: not identical; culprits: contrast, 6 messages>",
    ]
