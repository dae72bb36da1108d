"""The perception graph on the bundled recording: sensors in, a scene graph out, the same again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from made_onnx import node, write_model
from typer.testing import CliRunner

import dataflow
from dataflow.cli.main import app
from dataflow.graph import load_graph
from dataflow.messages import SceneGraph
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


def keypoint_model(file: Path) -> str:
    """A network of RTMPose's signature that finds all joints in the middle of a person's box."""
    pytest.importorskip("onnx")
    middle = {
        name: np.eye(1, side, side // 2, np.float32).repeat(17, 0)[None] for name, side in (("x", 384), ("y", 512))
    }
    nodes = [node("Identity", name, f"simcc_{name}") for name in middle]
    made = {f"simcc_{name}": each.shape for name, each in middle.items()}
    return write_model(file, nodes, {"input": [1, 3, 256, 192]}, made, values=middle)


@pytest.mark.long
@needs_weights
def test_the_recording_becomes_a_scene_graph_that_verifies_and_answers(tmp_path: Path) -> None:
    file, graph = tmp_path / "room.mcap", REPOSITORY / "graphs" / "perception.yaml"
    demo = REPOSITORY / "recordings" / "demo.mcap"
    keypoints = json.dumps({"model": keypoint_model(tmp_path / "joints.onnx"), "decoder": "simcc"})
    values = ("mount=true", "calibrate=true", "skeletons=true", f"keypoints_params={keypoints}")
    found = [word for value in values for word in ("--set", f"perception.{value}")]
    run("replay", demo, "--graph", graph, "--end", 1.2, *found, "--one-process", "--record", file, "--json", "-q")

    recorded = dataflow.open(file)
    corrected, mounted = (recorded[f"robot1/perception/{each}"] for each in ("calibration/corrected", "mount/status"))
    assert len(corrected) == len(mounted) == 1
    joints, postures = (recorded[f"robot1/perception/{each}"] for each in ("keypoints/keypoints", "skeletons/postures"))
    assert len(joints) == len(postures) > 5
    assert json.loads(run("verify", file, "--jobs", "1", "--json", "-q"))["identical"] is True
    shown = json.loads(CliRunner().invoke(scene, [str(file), "--json"]).stdout)
    assert {n["name"] for n in shown["nodes"]} >= {"room", "self", "floor"}
    assert any(n["class"] == "bin" for n in shown["nodes"])
    asked = CliRunner().invoke(scene, [str(file), "--query", "bin on floor"])
    assert asked.exit_code == 0
    assert "on floor" in asked.output


@pytest.mark.parametrize(("slam", "tracker"), [(False, "odometry"), (True, "slam")])
def test_corrected_extrinsics_do_not_reach_the_trackers(slam: bool, tracker: str) -> None:
    words = ["perception.calibrate=true", f"perception.slam={slam}"]
    graph = load_graph(REPOSITORY / "graphs" / "perception.yaml", settings=words)

    corrected = {name for name, node in graph.nodes.items() if any("calibration/corrected" in s for s in node.taken)}
    assert f"perception/{tracker}" not in corrected
    assert {"perception/cloud", "perception/lifter"} <= corrected


def test_a_depth_sensor_reaches_odometry_slam_and_map() -> None:
    graph = load_graph(REPOSITORY / "graphs" / "perception_rgbd.yaml", settings=["depth_sensor=kinect_v1", "slam=true"])
    for name in ("odometry", "slam", "objects"):
        assert graph.nodes[f"perception/{name}"].params["depth_sensor"] == "kinect_v1"


@pytest.mark.parametrize(("adapt", "source"), [(False, "image_watch/checked"), (True, "adapter/adapted")])
def test_the_networks_see_adapted_images_where_that_is_asked_for(adapt: bool, source: str) -> None:
    graph = load_graph(REPOSITORY / "graphs" / "perception.yaml", settings=[f"perception.adapt={adapt}"])
    for network in ("detector", "segmenter"):
        assert graph.nodes[f"perception/{network}"].inputs["image"] == (f"robot1/perception/{source}",)


def test_where_boxes_and_masks_are_given_no_network_runs() -> None:
    nodes = load_graph(REPOSITORY / "graphs" / "perception_given.yaml").nodes
    assert not {f"perception/{each}" for each in ("detector", "segmenter")} & nodes.keys()
    lifter, tracker = nodes["perception/lifter"].inputs, nodes["perception/tracker"].inputs
    assert lifter["detections"] == tracker["detections"] == ("robot1/robot/objects",)
    assert lifter["segmentation"] == ("robot1/robot/masks",)
    assert nodes["perception/objects"].inputs["boxes"] == ("robot1/perception/lifter/boxes",)


@pytest.mark.parametrize("name", ["perception", "perception_rgbd", "perception_kitti", "movers"])
def test_boxes_of_any_detector_reach_the_map_and_the_tracks_unchanged(name: str) -> None:
    nodes = load_graph(REPOSITORY / "graphs" / f"{name}.yaml").nodes
    (detector,) = (f"robot1/{each}/detections" for each in nodes if each == "perception/detector")
    for consumer in ("lifter", "tracker"):
        assert nodes[f"perception/{consumer}"].inputs["detections"] == (detector,)


@pytest.mark.parametrize(
    ("name", "word"), [("perception", "perception."), ("perception_rgbd", ""), ("perception_kitti", "")]
)
def test_boxes_with_masks_reach_the_map_and_the_tracks_where_they_are_asked_for(name: str, word: str) -> None:
    words = [f"{word}masks=true", f"{word}masker=own.onnx"]
    nodes = load_graph(REPOSITORY / "graphs" / f"{name}.yaml", settings=words).nodes
    assert nodes["perception/masks"].params["model"] == "own.onnx"
    assert nodes["perception/masks"].inputs["detections"] == ("robot1/perception/detector/detections",)
    for consumer in ("lifter", "tracker"):
        assert nodes[f"perception/{consumer}"].inputs["detections"] == ("robot1/perception/masks/masked",)


@pytest.mark.parametrize("name", ["perception", "perception_given", "perception_rgbd", "perception_kitti"])
def test_one_setting_gives_every_operator_the_label_space(name: str) -> None:
    nodes = load_graph(REPOSITORY / "graphs" / f"{name}.yaml", settings=["labels=own.yaml"]).nodes
    spaces = {each: node.params["labels"] for each, node in nodes.items() if "labels" in node.params}
    assert {"perception/lifter", "perception/objects", "perception/scene"} <= spaces.keys()
    assert set(spaces.values()) == {"own.yaml"}


@pytest.mark.parametrize("name", ["perception", "perception_rgbd"])
def test_rooms_reach_the_scene_graph_where_they_are_asked_for(name: str) -> None:
    file = REPOSITORY / "graphs" / f"{name}.yaml"
    nodes, plain = load_graph(file, settings=["rooms=true"]).nodes, load_graph(file).nodes
    assert nodes["perception/scene"].inputs["rooms"] == ("robot1/perception/rooms/rooms",)
    assert nodes["perception/floor"].params["lower"] > 1.0  # above desks
    assert not {"perception/floor", "perception/rooms"} & plain.keys()


@pytest.mark.parametrize("name", ["perception", "perception_rgbd"])
def test_with_slam_the_map_gets_its_pose_and_its_keyframes(name: str) -> None:
    nodes = load_graph(REPOSITORY / "graphs" / f"{name}.yaml", settings=["slam=true"]).nodes
    assert nodes["perception/objects"].inputs["keyframes"] == ("robot1/perception/placed/keyframes",)
    for each in ("objects", "lifter", "planes"):
        assert nodes[f"perception/{each}"].inputs["pose"] == ("robot1/perception/placed/odometry",)
    assert nodes["perception/scene"].inputs["robot"] == ("robot1/perception/placed/odometry",)
    assert nodes["perception/placed"].inputs["path"] == ("robot1/perception/slam/path",)


def test_postures_reach_the_activities_wherever_there_is_depth() -> None:
    nodes = load_graph(REPOSITORY / "graphs" / "perception.yaml").nodes
    assert nodes["perception/postures"].inputs["clusters"] == ("robot1/perception/lifter/clusters",)
    assert nodes["perception/people"].inputs["postures"] == ("robot1/perception/postures/postures",)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "folder", "cut", "left_out", "must"),
    [
        ("perception_rgbd", "rgbd_7scenes", "camera.stop=12", {"scans", "fusion", "wheeled", "segmenter"}, set()),
        ("perception_kitti", "kitti_lidar_camera", "car.stop=6", {"odometry", "cloud", "fusion"}, {"car"}),
    ],
)
def test_real_frames_become_a_scene_graph_that_verifies(
    name: str, folder: str, cut: str, left_out: set[str], must: set[str], data_dir: Path, tmp_path: Path
) -> None:
    data = data_dir
    if not ((data / folder).is_dir() and (data / "models" / "FastestDet.onnx").is_file()):
        pytest.skip(f"no {folder} and models/FastestDet.onnx in {data}")
    file, settings = tmp_path / "real.mcap", {"data": str(data), cut.partition("=")[0]: int(cut.partition("=")[2])}
    graph = load_graph(REPOSITORY / "graphs" / f"{name}.yaml", settings=[f"{k}={v}" for k, v in settings.items()])
    assert {f"perception/{each}" for each in left_out} <= graph.left_out.keys()

    dataflow.run(graph, record=file)

    assert dataflow.verify(file, jobs=1).identical
    last = dataflow.open(file)["robot1/perception/scene/graph"][-1]
    assert isinstance(last, SceneGraph)
    assert must <= {last.class_names[c] for c in last.class_ids.tolist()}


@pytest.mark.parametrize("name", ["perception", "perception_rgbd", "perception_kitti"])
def test_one_parameter_sets_the_provider_of_all_networks(name: str) -> None:
    nodes = load_graph(
        REPOSITORY / "graphs" / f"{name}.yaml", settings=["provider=cuda", "perception.embed=true"]
    ).nodes
    networks = ("perception/detector", "perception/embedder")
    assert [nodes[each].params["provider"] for each in networks] == ["cuda", "cuda"]
