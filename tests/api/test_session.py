"""A graph that a program feeds step by step gives what its run gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dataflow
from dataflow.messages import Image
from dataflow.supervision.core.report import RunFailed
from operators.cloud import CloudBuilder
from operators.odometry import BaseOdometry, VisualOdometry
from operators.sources import SyntheticRgbd

STATICS = ("depth_info", "image_info", "extrinsics")
INPUTS = {name: f"camera/{name}" for name in ("depth", "image", *STATICS)}


def small(folder: str = ".") -> dataflow.Graph:
    graph = dataflow.Graph("small", namespace="robot1", folder=folder)
    graph.add("camera", SyntheticRgbd, frames=5, rate=30)
    graph.add("cloud", CloudBuilder, stride=8).connect("cloud", **INPUTS)
    return graph.add("odometry", VisualOdometry).connect("odometry", **INPUTS)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> dataflow.RunResult:
    return small().run(record=tmp_path_factory.mktemp("session") / "run.mcap")


def fed(run: dataflow.RunResult, session: dataflow.Session) -> dict[str, list[bytes]]:
    streams, digests = run.open(), dict[str, list[bytes]]()
    for image, depth in zip(streams["image"], streams["camera/depth"], strict=True):
        for name, messages in session.put(image.stamp, {"camera/image": image, "camera/depth": depth}).items():
            digests.setdefault(name, []).extend(m.digest() for m in messages)
    return digests


def statics(run: dataflow.RunResult) -> dict[str, dataflow.messages.Message]:
    return {f"camera/{name}": run.open()[name][0] for name in STATICS}


def test_a_session_gives_the_messages_of_a_run_and_its_recording_verifies(
    run: dataflow.RunResult, tmp_path: Path
) -> None:
    file = tmp_path / "session.mcap"
    with dataflow.Session(small(), static=statics(run), outputs=["cloud/cloud", "odometry/odometry"], record=file) as s:
        made = fed(run, s)
    assert made == {name: [m.digest() for m in run.open()[name]] for name in ("cloud/cloud", "odometry/odometry")}
    assert dataflow.verify(file).identical
    again, first = dataflow.replay(file).digests(), run.digests()
    assert [again[f"robot1/{name}"] for name in made] == [first[f"robot1/{name}"] for name in made]


def test_session_step_returns_no_undecided_messages(run: dataflow.RunResult) -> None:
    first = run.open()["image"][0]
    with dataflow.Session(small(), static=statics(run)) as session:
        assert "cloud/cloud" not in session.put(first.stamp, {"camera/image": first})
        assert session.put(first.stamp + 1, {}) == {}


def test_session_refuses_a_mismatched_input_and_continues(run: dataflow.RunResult) -> None:
    first, second = run.open()["image"][:2]
    with dataflow.Session(small(), static=statics(run)) as session:
        session.put(first.stamp, {"camera/image": first})
        with pytest.raises(ValueError, match="stamps must increase"):
            session.put(first.stamp, {"camera/image": first})
        with pytest.raises(ValueError, match="has stamp"):
            session.put(second.stamp, {"camera/image": first})
        with pytest.raises(ValueError, match=r"no stream 'camera/imge' of a source: did you mean 'camera/image'\?"):
            session.put(second.stamp, {"camera/imge": second})
        with pytest.raises(TypeError, match="camera/depth takes DepthImage, not Image"):
            session.put(second.stamp, {"camera/depth": second})
        session.put(second.stamp, {"camera/image": second})
    with pytest.raises(ValueError, match="closed"):
        session.put(second.stamp + 1, {})


def test_session_without_required_streams_names_the_missing_one(run: dataflow.RunResult) -> None:
    with pytest.raises(ValueError, match="no message for the static stream 'camera/depth_info'"):
        dataflow.Session(small(), static={k: v for k, v in statics(run).items() if "depth" not in k})
    with pytest.raises(ValueError, match="no stream 'cloud/clouds'"):
        dataflow.Session(small(), static=statics(run), outputs=["cloud/clouds"])


def test_an_operator_that_fails_ends_the_session_and_is_named(run: dataflow.RunResult) -> None:
    depth = run.open()["camera/depth"][0]
    wrong = Image(stamp=depth.stamp, frame="camera", data=np.zeros((2, 2, 3), np.uint8))
    with dataflow.Session(small(), static=statics(run)) as session:
        with pytest.raises(RunFailed, match="failed in fire at stamp 0: ValueError: image has 2x2 pixels"):
            session.put(depth.stamp, {"camera/image": wrong, "camera/depth": depth})
        with pytest.raises(ValueError, match="closed"):
            session.put(depth.stamp + 1, {})


def test_a_graph_built_in_python_nests_graph_files(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text(
        "graph: base\ninputs: {sensor: Odometry, extrinsics: Transforms?}\noutputs: {odometry: base/odometry}\n"
        "operators:\n  base: {use: 'operators.odometry:BaseOdometry', "
        "inputs: {sensor: sensor, extrinsics: extrinsics}}\n"
    )
    graph = small(str(tmp_path)).add("robot", "base.yaml")
    graph.connect("robot", sensor="odometry/odometry", extrinsics="camera/extrinsics")
    built = graph.build({"robot/base.base_frame": "body"})
    assert built.nodes["robot/base"].operator is BaseOdometry
    assert built.nodes["robot/base"].params["base_frame"] == "body"
