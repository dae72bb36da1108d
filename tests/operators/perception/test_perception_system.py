"""Perception as one object gives what the graph gives, and says what is wrong with what it is given."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_books import BOOKS

import dataflow
from dataflow.messages import CameraInfo, Image, Message, Transforms
from operators.codec import DepthDecoder, ImageDecoder
from operators.perception import PerceptionResult, PerceptionSystem
from operators.weights import shipped

REPOSITORY = Path(__file__).resolve().parents[3]
DEMO = REPOSITORY / "recordings" / "demo.mcap"
ALL = ("image", "depth", "points", "imu", "wheels")
END = 0.8

pytestmark = pytest.mark.skipif(
    not (shipped("detector.onnx").is_file() and shipped("segmenter.onnx").is_file()),
    reason="the networks are not in operators/weights",
)


@dataclass(frozen=True)
class Room:
    """The beginning of the bundled recording: what the sensors measured by stamp, and their calibrations."""

    steps: dict[int, dict[str, Any]]
    image_info: CameraInfo
    depth_info: CameraInfo
    extrinsics: Transforms

    def system(self, sensors: tuple[str, ...] | None = None, **options: Any) -> PerceptionSystem:
        infos = {"image_info": self.image_info, "depth_info": self.depth_info}
        if sensors is not None:
            infos = {name: info for name, info in infos.items() if name.removesuffix("_info") in sensors}
        return PerceptionSystem(sensors, extrinsics=self.extrinsics, **(infos | options))

    def given(self, *sensors: str) -> Iterator[tuple[int, dict[str, Any]]]:
        for stamp, step in self.steps.items():
            if chosen := {name: message for name, message in step.items() if name in sensors}:
                yield stamp, chosen


@pytest.fixture(scope="module")
def room() -> Room:
    whole = dataflow.open(DEMO)
    steps: dict[int, dict[str, Any]] = {}
    ports = {"image_jpeg": "image", "depth_png": "depth", "points": "points", "imu": "imu", "wheel_odometry": "wheels"}
    decoders = {"image": ImageDecoder(), "depth": DepthDecoder()}
    for stream, name in ports.items():
        for message in whole.between(0, END)[stream]:
            decoder = decoders.get(name)
            steps.setdefault(message.stamp, {})[name] = message if decoder is None else decoder.decode(message)
    infos: Any = (whole[name][0] for name in ("image_info", "depth_info", "extrinsics"))
    return Room(dict(sorted(steps.items())), *infos)


def digests(results: list[PerceptionResult]) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    for result in results:
        for name, message in result.made().items():
            found.setdefault(name, []).append(message.digest())
    return found


@pytest.mark.long
def test_the_results_are_those_of_the_graph_and_the_recording_verifies(room: Room, tmp_path: Path) -> None:
    graph, handed = tmp_path / "graph.mcap", tmp_path / "handed.mcap"
    dataflow.replay(DEMO, graph=REPOSITORY / "graphs" / "perception.yaml", end=END, record=graph)
    with room.system(ALL, record=handed, labels="simulator") as system:
        made = digests([system.process(stamp, **step) for stamp, step in room.given(*ALL)])

    streams = dataflow.open(graph)
    ports = {
        "detections": "detector/detections", "segmentation": "segmenter/segmentation", "tracks": "tracker/tracks",
        "boxes": "lifter/boxes", "pose": "fusion/odometry", "objects": "objects/objects", "graph": "scene/graph",
        "activities": "scene/activities", "changes": "scene/changes",
    }  # fmt: skip
    assert made.keys() == {*ports, "cloud"}
    for name, port in ports.items():
        assert made[name] == [m.digest() for m in streams[f"robot1/perception/{port}"]], name
    assert dataflow.verify(handed).identical


@pytest.mark.long
def test_several_samples_of_one_step_are_taken_at_their_own_stamps(room: Room) -> None:
    stamps = [stamp for stamp, _ in room.given("image")]
    frames = dict(room.given("image", "depth"))
    with (
        room.system(("image", "depth", "imu", "wheels")) as one,
        room.system(("image", "depth", "imu", "wheels")) as two,
    ):
        singly = [one.process(stamp, **step) for stamp, step in room.given("image", "depth", "imu", "wheels")]
        together = []
        for before, stamp in zip([-1, *stamps], stamps, strict=False):
            within = [step for at, step in room.steps.items() if before < at <= stamp]
            batches: dict[str, Any] = {n: [step[n] for step in within if n in step] for n in ("imu", "wheels")}
            together.append(two.process(stamp, **frames[stamp], **batches))
    first = [pose.digest() for result in singly for pose in result.poses]
    second = [pose.digest() for result in together for pose in result.poses]
    assert len(second) > 10
    assert first[: len(second)] == second
    assert digests(singly)["graph"] == digests(together)["graph"]


@pytest.mark.long
def test_without_fusion_the_camera_gives_the_pose_and_arrays_will_do(room: Room) -> None:
    with room.system() as system:
        assert system.sensors == ("image", "depth")
        for stamp, step in list(room.given("image", "depth"))[:4]:
            result = system.process(stamp, image=step["image"].data, depth=step["depth"].data)
    assert result.pose is not None
    assert result.masks is result.segmentation is not None
    assert {"odometry", "lifter", "objects"} <= result.status.keys()
    assert {"cloud", "detections", "tracks", "boxes", "objects", "graph"} <= result.made().keys()


@pytest.mark.long
def test_missing_sensor_disables_only_its_dependents(room: Room) -> None:
    with room.system(("image", "depth", "imu", "wheels")) as system:
        for stamp, step in room.given("image", "depth", "imu", "wheels"):
            whole = system.process(stamp, **step)
            if "image" in step and whole.graph is not None:
                break
        following = [item for item in room.given("image", "depth", "imu", "wheels") if item[0] > stamp][:10]
        for stamp, step in following:
            if "image" in step:
                blind = system.process(stamp, **{name: m for name, m in step.items() if name != "depth"})
            else:
                system.process(stamp, **step)
    assert blind.detections is not None
    assert blind.pose is not None
    assert blind.cloud is None
    assert blind.graph is None
    assert system.graph.stamp < blind.stamp


def test_a_camera_whose_base_is_found_needs_no_extrinsics(room: Room) -> None:
    """The registered images of one camera, as most drivers give them."""
    depth_info = room.depth_info.replace(frame=room.image_info.frame)
    given = {"image_info": room.image_info, "depth_info": depth_info, "segment": False}
    with pytest.raises(ValueError, match=r"Transforms\.level_camera\(height, pitch\); .* mount=True finds it"):
        PerceptionSystem(**given)
    with PerceptionSystem(**given, mount=True, surfaces=False) as system:
        assert system.graph is None
        for stamp, step in list(room.given("image", "depth"))[:2]:
            images = {name: message.data for name, message in step.items()}
            result = system.process(stamp, **images)
        assert result.cloud is not None
        assert "mount" not in system.left_out


CHOICES = {
    "image": ({"detections", "segmentation", "tracks"}, {"lifter", "objects", "scene", "fusion", "base"}),
    "image points": ({"detections", "cloud", "pose"}, {"odometry", "fusion", "wheeled"}),
    "imu wheels": (set(), {"detector", "lifter", "scene", "wheeled"}),
    "wheels command": (set(), {"fusion", "scene"}),
}
"""Sensors → what they give, and the operators that they leave out."""


@pytest.mark.parametrize(
    "chosen", [pytest.param(n, marks=() if n == "imu wheels" else pytest.mark.long) for n in CHOICES]
)
def test_system_runs_with_any_subset_of_sensors(room: Room, chosen: str) -> None:
    sensors, (there, gone), made = tuple(chosen.split()), CHOICES[chosen], set[str]()
    with room.system(sensors) as system:
        assert gone <= system.left_out.keys()
        for stamp, step in list(room.given(*sensors))[:60]:
            made |= system.process(stamp, **step).made().keys()
    assert made >= there or made == {"pose"}
    if "imu" in sensors or "wheels" in sensors:
        assert "pose" in made


def test_no_detection_of_a_detector_of_ones_own_is_lost(room: Room) -> None:
    """Nothing that was trained on other objects stands between the detector and what follows."""
    with room.system(detector_operator="made_books:BookDetector", detector_params={}, segment=False) as system:
        for stamp, step in list(room.given("image", "depth"))[:3]:
            result = system.process(stamp, **step)
            np.testing.assert_array_equal(result.detections.boxes, BOOKS)
            assert result.detections.labels() == ("book",) * len(BOOKS)
    assert sorted(result.tracks.boxes[:, 0].round().tolist()) == BOOKS[:, 0].tolist()
    assert set(result.tracks.labels()) == {"book"}


def test_mismatched_input_is_refused_and_the_system_continues(room: Room) -> None:
    (first, given), (second, following) = list(room.given("image", "depth"))[:2]
    image, depth = given["image"].data, given["depth"].data
    wrong: list[tuple[type[Exception], str, int, dict[str, Any]]] = [
        (ValueError, "image has 10x20 pixels, but image_info describes 320x240", first,
         {"image": np.zeros((20, 10, 3), np.uint8), "depth": depth}),
        (ValueError, "image is in frame 'other'", first, {"image": Image(stamp=first, frame="other", data=image)}),
        (TypeError, "depth is in metres, as floating-point numbers, not uint16", first,
         {"image": image, "depth": (depth * 1000).astype(np.uint16)}),
        (ValueError, "made for image, depth, not for imu", first, {"imu": next(room.given("imu"))[1]["imu"]}),
        (TypeError, "depth takes DepthImage, not Image", first, {"depth": given["image"]}),
        (ValueError, "image has stamp", first - 1, {"image": given["image"]}),
    ]  # fmt: skip
    with room.system() as system:
        for kind, text, stamp, measured in wrong:
            with pytest.raises(kind, match=text):
                system.process(stamp, **measured)
        assert system.process(first, image=image, depth=depth).pose is not None
        with pytest.raises(ValueError, match="stamps must increase"):
            system.process(first, image=image, depth=depth)
        assert system.process(second, **following).cloud is not None


@pytest.mark.parametrize(
    ("sensors", "options", "fault"),
    [
        (None, {}, "no sensor: give image_info and depth_info"),
        (("image", "lidar"), {}, "no sensor 'lidar': there are image, depth"),
        (("image", "depth"), {"image_info": 1}, "depth needs its calibration: depth_info"),
        (("image", "points"), {"extrinsics": 1}, "image with points needs its calibration: image_info"),
        (("imu", "points"), {}, "points and imu: extrinsics must say where the sensors are"),
        (("wheels",), {"fusion": {"depth": {}}}, "fusion has no settings of 'depth' here; there are wheels"),
    ],
    ids=["none", "unknown", "depth_info", "image_info", "extrinsics", "fusion"],
)
def test_missing_or_unknown_settings_are_named(
    room: Room, sensors: tuple[str, ...] | None, options: dict[str, Any], fault: str
) -> None:
    real: dict[str, Message] = {"image_info": room.image_info, "extrinsics": room.extrinsics}
    with pytest.raises(ValueError, match=fault):
        PerceptionSystem(sensors, **{name: real.get(name, value) for name, value in options.items()})
