"""Bags replayed through graphs: live processes, recorded, verified, from real bags too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_bags import SECOND, header, ros, write_ros2, xyz, xyzw
from rosbags.highlevel import AnyReader

import dataflow
from dataflow.graph import load_graph
from dataflow.interop.mapping import MappingError
from dataflow.interop.opening import open_bag
from dataflow.interop.playing import match, play
from dataflow.recording import Recording

TRAJECTORIES = """
graph: trajectories
namespace: robot1
operators:
  slam: {use: "operators.sources:RecordedPose"}
  truth: {use: "operators.sources:RecordedPose"}
  metrics:
    use: operators.evaluation:TrajectoryMetrics
    inputs: {estimate: slam/odometry, ground_truth: truth/pose}
"""
DETECTION = """
graph: detection
operators:
  camera: {use: "operators.sources:RecordedCamera"}
  detector:
    use: operators.detection:OnnxDetector
    inputs: {image: camera/image}
    params: {model: MODEL, decoder: fastestdet, score_threshold: 0.3}
"""


@pytest.fixture
def graph(tmp_path: Path) -> Path:
    path = tmp_path / "graph.yaml"
    path.write_text(TRAJECTORIES)
    return path


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    rows = []
    for i in range(50):
        stamp = 1_700_000_000 * SECOND + i * SECOND // 10
        for topic in ("/estimate", "/truth"):
            pose = ros(
                "geometry_msgs/Pose", position=xyz(0.1 * i, np.sin(i / 5), 0, "Point"), orientation=xyzw(0, 0, 0, 1)
            )
            rows.append((topic, stamp + 1000, ros("geometry_msgs/PoseStamped", header=header(stamp, "map"), pose=pose)))
    return write_ros2(tmp_path / "bag", rows)


MAPS = ["/estimate=slam/odometry", "/truth=truth/pose"]


def test_mapping_that_is_not_clear_is_an_error_with_the_topics_and_the_proposal(graph: Path, bag: Path) -> None:
    with pytest.raises(MappingError) as caught:
        match(bag, load_graph(graph), []).played()

    told = str(caught.value)
    assert "/estimate        50  Pose or Odometry" in told
    assert "--map /truth=truth/pose" in told


def test_bag_replayed_in_this_process_is_recorded_and_verified(graph: Path, bag: Path, tmp_path: Path) -> None:
    from dataflow.cli.support.arguments import BagOptions
    from dataflow.cli.support.bags import replay_bag
    from dataflow.cli.support.execution import Outputs
    from dataflow.cli.support.run_options import ReportOptions

    loaded, file = load_graph(graph), tmp_path / "out.mcap"
    outputs = Outputs(file, None, None, False, False)
    options = {"placement": "one_process", "record": file}
    replay_bag(bag, loaded, BagOptions(MAPS), None, None, outputs, options, ReportOptions(quiet=True), began=0.0)

    with Recording(file) as made:
        assert made.metadata["dataflow:bag"]["clock"] == "header: when it was measured"
        assert made.streams["robot1/truth/pose"].count == 50
        assert {m.message.frame for m in made.messages()} == {"map"}
    assert dataflow.verify(file).identical


def test_span_of_a_bag_is_counted_from_its_first_message(graph: Path, bag: Path) -> None:
    from dataflow.supervision.replay import plan_replay

    with play(bag, load_graph(graph), MAPS) as streams:
        plan = plan_replay(streams, load_graph(graph), start=1.0, end=2.0)
        part = list(streams.messages(["robot1/truth/pose"], plan.start, plan.end))

    assert len(part) == 11


def test_recorded_sources_cannot_be_run(graph: Path) -> None:
    with pytest.raises(Exception, match="replay one into the graph"):
        dataflow.run(str(graph))


@pytest.mark.long
@pytest.mark.data
def test_camera_bag_of_others_feeds_a_detector_and_verifies(data_dir: Path, tmp_path: Path) -> None:
    file = tmp_path / "graph.yaml"
    file.write_text(DETECTION.replace("MODEL", str(data_dir / "models" / "FastestDet.onnx")))
    out = tmp_path / "out.mcap"

    dataflow.replay(data_dir / "bags" / "foxglove_camera_jsonschema.mcap", graph=str(file), record=out)

    with Recording(out) as made:
        assert made.streams["detection/detector/detections"].count == 10
    assert dataflow.verify(out).identical


def test_topics_that_are_not_played_survive_in_the_recording_byte_for_byte(
    graph: Path, bag: Path, tmp_path: Path
) -> None:
    rows = [
        (topic, 1_700_000_000 * SECOND + k, ros("std_msgs/String", data=f"{topic} {k}"))
        for topic in ("/said", "/odd")
        for k in range(3)
    ]
    both = write_ros2(tmp_path / "both", [*rows, *_rows_of(bag)])
    file = tmp_path / "out.mcap"

    dataflow.replay(both, graph=str(graph), record=file, maps=dict(word.split("=") for word in MAPS))

    before, after = open_bag(both), open_bag(file)
    kept = [(s.topic, s.log_time, bytes(s.data)) for s in before.messages(["/said", "/odd"])]
    assert [(s.topic, s.log_time, bytes(s.data)) for s in after.messages(["/said", "/odd"])] == kept
    assert len(kept) == 6
    assert after.topics["/said"].schema == before.topics["/said"].schema
    assert dataflow.verify(file).identical


def _rows_of(bag: Path) -> list[Any]:
    with AnyReader([bag]) as reader:
        return [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]


def test_recording_of_a_replay_uses_the_clock_of_the_bag(graph: Path, tmp_path: Path) -> None:
    rows = []
    for i in range(20):
        simulated, wall = (900 + i) * SECOND, (1_700_000_000 + i) * SECOND
        for topic in ("/estimate", "/truth"):
            pose = ros("geometry_msgs/Pose", position=xyz(i, i * i, 0, "Point"), orientation=xyzw(0, 0, 0, 1))
            at = header(simulated, "map")
            rows.append((topic, wall, ros("geometry_msgs/PoseStamped", header=at, pose=pose)))
        rows.append(("/kept", wall, ros("geometry_msgs/Polygon")))
    bag = write_ros2(tmp_path / "bag", rows)

    dataflow.replay(bag, graph=str(graph), record=tmp_path / "o.mcap", maps=dict(word.split("=") for word in MAPS))

    with Recording(tmp_path / "o.mcap") as made:
        kept, played = made.streams["/kept"], made.streams["robot1/truth/pose"]
        assert (kept.first, kept.last) == (played.first, played.last) == (900 * SECOND, 919 * SECOND)


RGBD = """
graph: rgbd
operators:
  camera: {use: "operators.sources:RecordedRgbdCamera"}
  watch: {use: "operators.monitoring:ImageWatch", inputs: {image: camera/image}}
"""


def test_16_bit_grey_is_played_as_depth_where_it_is_mapped_to_depth(tmp_path: Path) -> None:
    (tmp_path / "g.yaml").write_text(RGBD)
    grey = {"width": 4, "height": 2, "encoding": "mono16", "step": 8, "data": np.full(16, 4, np.uint8)}
    color = {"width": 4, "height": 2, "encoding": "rgb8", "step": 12, "data": np.zeros(24, np.uint8)}
    at = 1_700_000_000 * SECOND
    rows = [("/d", at, ros("sensor_msgs/Image", header=header(at), **grey)),
            ("/c", at, ros("sensor_msgs/Image", header=header(at), **color))]  # fmt: skip
    bag, built = write_ros2(tmp_path / "bag", rows), load_graph(tmp_path / "g.yaml")

    told = match(bag, built, ["/d=camera/depth", "/c=camera/image"]).played()

    assert {played.topic: played.type for played in told.values()} == {"/d": "DepthImage", "/c": "Image"}
    with play(bag, built, ["/d=camera/depth", "/c=camera/image"]) as streams:
        depth = next(m.message for m in streams.messages() if m.stream.endswith("depth"))
    assert depth.data[0, 0] == np.float32(1.028)


def test_16_bit_grey_is_never_proposed_as_depth(tmp_path: Path) -> None:
    (tmp_path / "g.yaml").write_text(RGBD)
    grey = {"width": 4, "height": 2, "encoding": "mono16", "step": 8, "data": np.full(16, 4, np.uint8)}
    at = 1_700_000_000 * SECOND
    bag = write_ros2(tmp_path / "bag", [("/d", at, ros("sensor_msgs/Image", header=header(at), **grey))])

    found = match(bag, load_graph(tmp_path / "g.yaml"), [])

    assert [reading.read_as.SCHEMA for reading in found.readings if reading.read_as] == ["Image16"]
    assert found.options() == ["/d=camera/image"]
