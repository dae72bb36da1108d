"""What operators need that no graph of graphs/ runs alone, made here: weights, a video, a bag, parts of a recording.

Of `repeated_graphs.py`. All is made in a folder, by commands of the project and generators of a fixed seed. Weights of
torchvision are drawn at random, so that nothing is downloaded, and say nothing about how good a network is.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import dataflow
from dataflow.messages import Detections2D, Twist
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import recorded_graph
from operators.perception import PerceptionSystem

DEMO = "recordings/demo.mcap"
CLASSES = ("__background__", "person", "mug", "chair")
RECORDED = """
graph: recorded
namespace: robot1
operators:
  camera: {use: "operators.sources:RecordedCamera"}
  rgbd: {use: "operators.sources:RecordedRgbdCamera"}
  stereo: {use: "operators.sources:RecordedStereoCamera"}
  lidar: {use: "operators.sources:RecordedLidar"}
  imu: {use: "operators.sources:RecordedImu"}
  pose: {use: "operators.sources:RecordedPose"}
  tree: {use: "operators.sources:RecordedTransforms"}
"""
SENSED = """
graph: sensed
namespace: robot1
operators:
  robot:
    use: operators.simulator:SimulatedRobot
    params:
      duration: 600ms
      color_camera: {rate: 5}
      depth_camera: {rate: 5}
      stereo: {rate: 5, width: 320, height: 240}
      lidar: {rate: 5, resolution: 0.05}
      inertial: {rate: 100}
      magnetometer: {rate: 20}
      wheels: {rate: 20}
      truth: {poses: 10, boxes: false, relations: 0, activities: 0}
"""
TOPICS = {
    "image": "camera/image",
    "depth": "rgbd/depth",
    "left": "stereo/left",
    "right": "stereo/right",
    "points": "lidar/points",
    "imu": "imu/imu",
    "magnetic_field": "imu/magnetic_field",
    "wheel_odometry": "pose/odometry",
    "ground_truth": "pose/pose",
}
"""Port of the simulated robot → the stream of the graph above that its topic feeds; `tree` has /tf_static."""
ADAPTED = """
graph: adapted
namespace: robot1
operators:
  robot:
    use: operators.simulator:SimulatedRobot
    params:
      duration: 1s
      color_camera: {rate: 10, read_noise: 6}
      depth_camera: {rate: 0}
      lighting: [{span: [0.4, 1], level: 0.15}]
      truth: {poses: 0, boxes: false, relations: 0, activities: 0}
  adapter:
    use: operators.image:ImageAdapter
    inputs: {image: robot/image}
"""
PLOTS = """
graph: plots
namespace: robot1
operators:
  robot:
    use: operators.simulator:SimulatedRobot
    params: {duration: 21s, seed: 11, first_stamp: 1700000000000000000}
  plots:
    use: operators.evaluation:TrajectoryPlots
    inputs: {estimate: robot/wheel_odometry, ground_truth: robot/true_base}
    params: {alignment: origin, period: 1s}
"""
Row = dict[str, Any]


def torchvision(folder: Path) -> list[str]:
    """Part of graphs/torchvision.yaml, with networks of random weights."""
    _cut(folder / "torchvision.mcap", "200ms")
    files = {
        "detector": _random(folder, "detector", "ssdlite320_mobilenet_v3_large"),
        "segmenter": _random(folder, "segmenter", "lraspp_mobilenet_v3_large"),
        "features": _random(folder, "features", "mobilenet_v3_small"),
    }
    words = [word for name, (model, file) in files.items() for word in (f"{name}={model}", f"{name}.checkpoint={file}")]
    return [*words, "segmenter.side=128", "features.per=image"]


def torchvision_rig(folder: Path) -> list[str]:
    """Part of graphs/torchvision_rig.yaml, with networks of random weights."""
    detector, boxes = _random(folder, "detector", "ssdlite320_mobilenet_v3_large")
    segmenter, pixels = _random(folder, "segmenter", "lraspp_mobilenet_v3_large")
    words = [f"detector={detector}", f"detector.checkpoint={boxes}", f"segmenter={segmenter}"]
    words += [f"segmenter.checkpoint={pixels}", "segmenter.side=128", "robot.duration=300ms"]
    _record("graphs/torchvision_rig.yaml", folder / "torchvision_rig.mcap", words)
    return words


def recognition(folder: Path) -> list[str]:
    """Part of graphs/recognition.yaml, with the network of `dataflow train classifier` before it has learned."""
    import torch

    from operators.learning.export import export_network
    from operators.recognition.training import ClassifierNetwork, DeployedClassifier

    torch.manual_seed(7)
    file, facts = folder / "things.onnx", {"kind": "classifier", "classes": ["a", "b", "c"], "width": 64, "height": 64}
    network = DeployedClassifier(ClassifierNetwork(3)).eval()
    export_network(network, (64, 64), ["probabilities", "features"], facts, file)
    _cut(folder / "recognition.mcap", "500ms")
    return [f"weights={file}"]


def learned(folder: Path) -> list[str]:
    """Part of graphs/learned.yaml, with a ball learned by command from five images of the recording."""
    file, images = folder / "toy.object.npz", folder / "toy"
    _labelled(images, "ball", 5)
    _command("learn", "object", "toy", images, "--out", file)
    _cut(folder / "learned.mcap", "300ms")
    return [f"object={file}", "perception.segment=false"]


def segmentation(folder: Path) -> list[str]:
    """graphs/segmentation.yaml, with a video of the recording's images and a network of random weights."""
    import onnx

    rng, make = np.random.default_rng(3), onnx.helper
    weights = {"w": rng.normal(0, 0.1, (8, 3, 3, 3)), "v": rng.normal(0, 0.1, (4, 8, 3, 3))}
    same: dict[str, Any] = {"pads": [1, 1, 1, 1]}
    graph = make.make_graph(
        [
            make.make_node("Conv", ["x", "w"], ["wide"], **same),
            make.make_node("Relu", ["wide"], ["bent"]),
            make.make_node("Conv", ["bent", "v"], ["scores"], **same),
        ],
        "colours",
        [make.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 3, 120, 160])],
        [make.make_tensor_value_info("scores", onnx.TensorProto.FLOAT, [1, 4, 120, 160])],
        [onnx.numpy_helper.from_array(one.astype(np.float32), name) for name, one in weights.items()],
    )
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 17)], ir_version=9)
    onnx.helper.set_model_props(model, {"names": json.dumps(["floor", "wall", "mug", "chair"])})
    onnx.save(model, str(folder / "street.onnx"))
    video = cv2.VideoWriter(str(folder / "street.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (320, 240))
    for pixels, _ in _seen(12):
        video.write(pixels)
    video.release()
    return [f"input={folder / 'street.avi'}", f"model={folder / 'street.onnx'}"]


def adapted(folder: Path) -> list[str]:
    """A second of images, noisy, and dark after the lamps are dimmed."""
    (folder / "adapted.yaml").write_text(ADAPTED, encoding="utf-8")
    _record(folder / "adapted.yaml", folder / "adapted.mcap", [])
    return []


def plots(folder: Path) -> list[str]:
    """Curves and pictures of the errors of wheel odometry, of part of the recording."""
    (folder / "plots.yaml").write_text(PLOTS, encoding="utf-8")
    _cut(folder / "plots.mcap", "3s")
    return []


def slam_round(folder: Path) -> list[str]:
    """graphs/slam.yaml over a whole round, with few images a second, so that the camera comes back to where it was."""
    return _round(folder, "slam", ["duration=24s", "robot.color_camera.rate=4", "robot.depth_camera.rate=4"])


def slam_lidar_round(folder: Path) -> list[str]:
    """graphs/slam_lidar.yaml until the LiDAR sees again what it saw before."""
    return _round(folder, "slam_lidar", ["duration=17s", "robot.lidar.rate=5"])


def recorded(folder: Path) -> list[str]:
    """A ROS 2 bag of a simulated robot, played into the sources that stand for sensors of bags."""
    (folder / "recorded.yaml").write_text(RECORDED, encoding="utf-8")
    _sensed(folder / "sensed.mcap")
    _command("convert", folder / "sensed.mcap", folder / "recorded.bag", "--to", "ros2", "--quiet")
    return []


def handed(folder: Path) -> list[str]:
    """Measurements of a simulated robot, to be handed to a `PerceptionSystem`."""
    _sensed(folder / "handed.mcap")
    return []


MADE: dict[str, Callable[[Path], list[str]]] = {
    function.__name__: function
    for function in (
        torchvision,
        torchvision_rig,
        recognition,
        learned,
        segmentation,
        adapted,
        plots,
        recorded,
        handed,
        slam_round,
        slam_lidar_round,
    )
}
"""Name → makes, in a folder, what it needs, and returns its settings."""


def maps() -> dict[str, str]:
    """Topic of the bag → stream of the graph."""
    return {f"/robot/{port}": stream for port, stream in TOPICS.items()} | {"/tf_static": "tree/fixed"}


def perceived(measured: Path) -> dict[str, Row]:
    """Hands recorded measurements to a `PerceptionSystem`; returns class, number of messages and digest by operator."""
    with dataflow.open(measured) as streams, tempfile.TemporaryDirectory() as folder:
        every: dict[str, list[Any]] = {
            name: list(streams[f"robot/{name}"]) for name in (*TOPICS, "image_info", "depth_info", "extrinsics")
        }
        told: dict[str, Any] = {name: every[name][0] for name in ("image_info", "depth_info", "extrinsics")}
        sensors, file, last = ("image", "depth", "points", "imu", "wheels", "command"), Path(folder) / "made.mcap", -1
        with PerceptionSystem(sensors, record=file, segment=False, **told) as system:
            for image in every["image"]:
                since = {k: [m for m in v if last < m.stamp <= image.stamp] for k, v in every.items()}
                command = Twist(
                    stamp=image.stamp, frame="base_link", linear=np.array([0.5, 0, 0]), angular=np.array([0, 0, 0.1])
                )
                depth, points = (next(iter(since[name]), None) for name in ("depth", "points"))
                system.process(
                    image.stamp, image=image, depth=depth, points=points, imu=since["imu"],
                    wheels=since["wheel_odometry"], command=command,
                )  # fmt: skip
                last = image.stamp
        with Recording(file) as made:
            found, graph = made.digests(), recorded_graph(made)
            counts = {name: info.count for name, info in made.streams.items()}
    rows: dict[str, Row] = {}
    for name, node in graph.nodes.items():
        own = sorted(set(node.outputs.values()) & set(found))
        digest = ",".join(f"{stream}:{found[stream]}" for stream in own)
        count = sum(counts[stream] for stream in own)
        rows[name] = {"operator": node.use.partition(":")[2], "messages": count, "digest": digest}
    return rows


def _cut(file: Path, until: str) -> None:
    _command("cut", DEMO, "--to", until, "--out", file, "--bare", "--quiet")


def _round(folder: Path, name: str, words: list[str]) -> list[str]:
    """Records a round of a graph. Raises RuntimeError where it closes no loop."""
    graph, file = folder / f"{name}_round.yaml", folder / f"{name}_round.mcap"
    graph.write_text(Path(f"graphs/{name}.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    _record(graph, file, words)
    with dataflow.open(file) as streams:
        states: list[Any] = list(streams["slam/status"])
        if not any("corrected" in text for state in states for text in state.messages):
            raise RuntimeError(f"{name}: no loop in {' '.join(words)}")
    return words


def _sensed(file: Path) -> None:
    graph = file.with_suffix(".robot.yaml")
    graph.write_text(SENSED, encoding="utf-8")
    _record(graph, file, [])


def _record(graph: str | Path, file: Path, words: list[str]) -> None:
    dataflow.run(graph, settings=dict(word.split("=", 1) for word in words), record=file)


def _command(*words: object) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dataflow.cli.main", *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"dataflow {' '.join(map(str, words))}: {(done.stderr or done.stdout).strip()[-300:]}")


def _random(folder: Path, part: str, name: str) -> tuple[str, Path]:
    """A network of torchvision with weights drawn at random, those of the last layer so large that some boxes are sure;
    its name and its file."""
    import torch
    from torchvision import models

    file = folder / f"{part}.pt"
    torch.manual_seed(3)
    sizes: dict[str, Any] = {} if part == "features" else {"weights_backbone": None}
    model = models.get_model(name, weights=None, num_classes=len(CLASSES), **sizes)
    for parameter, weight in model.named_parameters():
        if "classification_head" in parameter and parameter.endswith("bias"):
            torch.nn.init.normal_(weight, 0.0, 1.5)
    torch.save({"model": model.state_dict(), "classes": list(CLASSES)}, file)
    return name, file


def _seen(most: int, *, apart: int = 1) -> list[tuple[np.ndarray, Detections2D]]:
    """Images of the recording (BGR) with the true boxes in them."""
    with dataflow.open(DEMO) as streams:
        truth: dict[int, Any] = {m.stamp: m for m in streams["robot/objects"]}
        every: list[Any] = list(streams["robot/image_jpeg"])
        images = [m for m in every[::apart] if m.stamp in truth][:most]
        return [(np.asarray(cv2.imdecode(m.data, cv2.IMREAD_COLOR)), truth[m.stamp]) for m in images]


def _labelled(folder: Path, label: str, most: int) -> None:
    """Images in which things of a class are seen, with their boxes as COCO has them."""
    folder.mkdir()
    images: list[Mapping[str, Any]] = []
    boxes: list[Mapping[str, Any]] = []
    for pixels, truth in _seen(210, apart=5):
        own = [box for box, name in zip(truth.boxes.tolist(), truth.labels(), strict=True) if name == label]
        large = [(x, y, right - x, bottom - y) for x, y, right, bottom in own if min(right - x, bottom - y) >= 14]
        if not large or len(images) == most:
            continue
        name = f"{len(images)}.png"
        cv2.imwrite(str(folder / name), pixels)
        for box in large:
            boxes.append({"id": len(boxes), "image_id": len(images), "category_id": 0, "bbox": box, "iscrowd": 0})
        images.append({"id": len(images), "file_name": name, "width": pixels.shape[1], "height": pixels.shape[0]})
    if len(images) < most:
        raise RuntimeError(f"{DEMO}: {label} is large in {len(images)} images, not in {most}")
    told = {"images": images, "annotations": boxes, "categories": [{"id": 0, "name": "toy"}]}
    (folder / "annotations.json").write_text(json.dumps(told), encoding="utf-8")
