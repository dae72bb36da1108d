"""Networks that were trained in simulation: one warning line where they take what sensors measured, else none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_bags import imus, write_ros2

import dataflow
from dataflow.graph import load_graph
from dataflow.messages import Imu, Message
from dataflow.operator import In, Operator, Out, Param, Source
from dataflow.recording import Recording
from dataflow.supervision import run as running
from dataflow.supervision.sim_to_real import warn_of_gap


class Camera(Source):
    """Gives two measurements, as if a sensor had measured them."""

    seen: Out[Imu] = Out()

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for k in range(2):
            yield {
                "seen": Imu(stamp=1_000 + k, frame="imu", angular_velocity=np.zeros(3), linear_acceleration=np.zeros(3))
            }


class Simulated(Camera):
    """Gives the same, computed."""

    simulated = True


class Network(Operator):
    """Uses a network that was trained in simulation, unless it is given another."""

    seen: In[Imu] = In()
    found: Out[Imu] = Out()
    weights: str | None = Param(None, doc="a network file")

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        return params["weights"] is None

    def process(self, seen: Imu) -> Imu:
        return seen


def graph(camera: type[Camera], weights: str | None = None) -> dataflow.Graph:
    """A network, and another behind it."""
    made = dataflow.Graph("gap", namespace="robot1").add("camera", camera)
    made.add("near", Network, weights=weights).connect("near", seen="camera/seen")
    return made.add("far", Network, weights=weights).connect("far", seen="near/found")


def test_a_run_on_measured_data_warns_once_and_names_every_network(caplog: pytest.LogCaptureFixture) -> None:
    graph(Camera).run()
    (line,) = caplog.messages
    assert "trained in simulation alone" in line
    assert ": near, far;" in line


@pytest.mark.parametrize(("camera", "weights"), [(Simulated, None), (Camera, "own.onnx")])
def test_no_warning_in_simulation_nor_for_other_networks(
    camera: type[Camera], weights: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    graph(camera, weights).run()
    assert not caplog.messages


@pytest.mark.parametrize(("camera", "lines"), [(Camera, 1), (Simulated, 0)])
def test_a_replay_warns_by_the_sources_of_the_recorded_run(
    camera: type[Camera], lines: int, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    file = tmp_path / "run.mcap"
    graph(camera).run(record=file)
    caplog.clear()
    other = Simulated if camera is Camera else Camera
    dataflow.replay(file, graph=graph(other))
    assert len(caplog.messages) == lines


def test_a_replay_of_a_bag_warns_whatever_the_sources_of_the_graph(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    bag = write_ros2(tmp_path / "bag", imus([1_000, 2_000]))
    dataflow.replay(bag, graph=graph(Simulated), maps={"/imu": "camera/seen"})
    assert len(caplog.messages) == 1


def test_a_session_that_is_handed_measurements_warns(caplog: pytest.LogCaptureFixture) -> None:
    dataflow.Session(graph(Camera)).close()
    assert len(caplog.messages) == 1


def test_runs_in_processes_warn_before_they_start(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "run.mcap"
    graph(Camera, "own.onnx").run(record=file)
    monkeypatch.setattr(running, "execute", lambda *_, **__: None)
    running.run(graph(Camera).build())
    running.replay(file, graph=graph(Simulated).build())
    assert len(caplog.messages) == 2


@pytest.mark.parametrize(
    ("name", "recognize", "named"),
    [
        ("perception", True, []),
        ("perception_rgbd", False, []),
        ("perception_kitti", False, []),
        ("perception_rgbd", True, ["perception/postures", "perception/people"]),
    ],
)
def test_networks_trained_on_simulated_people_are_off_at_real_cameras_or_warned_of(
    name: str, recognize: bool, named: list[str], repository: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = ["perception.recognize=true"] if recognize else []
    graph = load_graph(repository / "graphs" / f"{name}.yaml", settings=settings)
    assert ("perception/people" in graph.nodes) == recognize
    warn_of_gap(graph)
    assert len(caplog.messages) == bool(named)
    assert all(each in caplog.text for each in named)


def test_the_bundled_recording_which_holds_the_files_of_its_graph_alone_is_simulated(
    repository: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Recording(repository / "recordings" / "demo.mcap") as played:
        warn_of_gap(load_graph(repository / "graphs" / "perception.yaml"), played)
    assert not caplog.messages
