"""What the shipped networks and a depth camera make of simulated worlds, with the truth: input of other benchmarks.

Each world is driven through once, at 640x480, or watched by a robot that stands; what was sensed is kept in a folder,
since networks are slow.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dataflow.messages import (
    Activity,
    Boxes3D,
    CameraInfo,
    Classification,
    Detections2D,
    Odometry,
    PointCloud,
    Pose,
    SceneGraph,
    SegmentationMap,
    Transforms,
)
from operators.cloud import CloudBuilder, PlaneSegmenter
from operators.detection import CustomDetector
from operators.recognition import PostureRecognizer
from operators.scene import ObjectLifter, SemanticMap
from operators.segmentation import Segmenter
from operators.simulator.robot import SimulatedRobot

Route = Literal["tour", "watch"]
KINDS = ("office", "table_top", "corridor")
RATE = 4.0
SECONDS: dict[Route, int] = {"tour": 50, "watch": 30}
ROUGH_DEPTH: dict[str, Any] = {"noise": 0.004, "quantum": 0.006, "specks": 0.08, "edge_holes": 1.0}
"""Errors of a structured-light or stereo camera: 4 mm and steps of 6 mm at 1 m, 8 % holes, no return at edges."""
SEARCH: dict[str, Any] = {"voxel": 0.08, "period": 2.0}
"""Parameters of PlaneSegmenter, as in graphs/core/perception.yaml."""


@dataclass(frozen=True)
class Frame:
    """One image: what was sensed, then what is true."""

    detections: Detections2D
    segmentation: SegmentationMap
    cloud: PointCloud
    camera: Pose
    base: Odometry
    objects: Detections2D
    boxes: Boxes3D
    masks: SegmentationMap
    scene: SceneGraph
    activities: Activity


@dataclass(frozen=True)
class World:
    name: str
    image_info: CameraInfo
    extrinsics: Transforms
    frames: list[Frame]


def in_view(objects: Detections2D, share: float, pixels: int = 0) -> NDArray[np.bool_]:
    """Which objects show at least this share of themselves, and so many pixels."""
    assert objects.visible is not None
    assert objects.pixel_counts is not None
    return (objects.visible >= share) & (objects.pixel_counts >= pixels)


def ids_in_view(objects: Detections2D, share: float) -> set[int]:
    """The ids of those."""
    assert objects.ids is not None
    return set(objects.ids[in_view(objects, share)].tolist())


class Mapper:
    """Lifter, planes and map, wired as in the perception graph."""

    def __init__(self, **params: Any) -> None:
        self.lifter, self.planes, self.known = (
            ObjectLifter(labels="simulator"),
            PlaneSegmenter(**SEARCH),
            SemanticMap(labels="simulator", **params),
        )
        for operator in (self.lifter, self.planes, self.known):
            operator.setup()

    def take(
        self, world: World, frame: Frame, detections: Detections2D, masks: SegmentationMap
    ) -> tuple[dict[str, Any], SceneGraph]:
        """Returns what was lifted from a frame, and the map after it."""
        found, made = self.step(world, frame, detections, masks)
        return found, made["nodes"]

    def step(
        self, world: World, frame: Frame, detections: Detections2D, masks: SegmentationMap
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Returns what was lifted from a frame, and all that the map gives after it."""
        found = self.lifter.process(detections, frame.cloud, world.image_info, world.extrinsics, masks, frame.camera)
        made = self.known.process(
            found["boxes"],
            found["clusters"],
            frame.cloud,
            frame.camera,
            world.extrinsics,
            found["images"],
            world.image_info,
            self.planes.process(frame.cloud, frame.camera, world.extrinsics).get("surfaces"),
        )
        return dict(found), dict(made)


@dataclass(frozen=True)
class Mapped:
    """The map from sensors after a frame, as nodes and as boxes with velocities, and the postures of its people."""

    nodes: SceneGraph
    objects: Boxes3D
    postures: Classification


def mapped(world: World) -> list[Mapped]:
    """Returns what is mapped after each frame."""
    mapper, recognizer = Mapper(), PostureRecognizer(labels="simulator")
    recognizer.setup()
    found = []
    for frame in world.frames:
        lifted, made = mapper.step(world, frame, frame.detections, frame.segmentation)
        look = lifted["boxes"], lifted["clusters"], frame.cloud, frame.camera, world.extrinsics
        found.append(Mapped(made["nodes"], made["objects"], recognizer.process(made["nodes"], *look)))
    return found


def miscalibrated(static: dict[str, Any]) -> dict[str, Any]:
    """Returns calibrations with a focal length of colour 1 % too long, and depth turned by 0.3 degrees twice."""
    info, tree = static["image_info"], static["extrinsics"]
    K = info.K.copy()
    K[[0, 1], [0, 1]] *= 1.01
    turned, depth = tree.rotations.copy(), tree.child_frames.index(static["depth_info"].frame)
    turned[depth] = (Rotation.from_quat(turned[depth]) * Rotation.from_euler("xy", [0.3, 0.3], degrees=True)).as_quat()
    return static | {"image_info": info.replace(K=K), "extrinsics": tree.replace(rotations=turned)}


def sense(kind: str, seed: int, route: Route, *, rough: bool) -> World:
    """Drives through a world; `rough`: with the noise of a real camera, and calibrations that are off."""
    color, depth = ({"read_noise": 3.0, "shutter": "15ms"}, ROUGH_DEPTH) if rough else ({}, {})
    robot = SimulatedRobot(
        world=kind,
        seed=seed,
        people=3,
        route=route,
        duration=f"{SECONDS[route]}s",
        color_camera={"rate": RATE, "width": 640, "height": 480, **color},
        depth_camera={"rate": RATE, **depth},
        truth={
            "poses": RATE,
            "relations": RATE,
            "spatial": route == "tour",
            "activities": RATE,
            "masks": True,
            "min_pixels": 50,
        },
    )
    builder, detector, segmenter = (
        CloudBuilder(stride=3, max_range=6.0),
        CustomDetector(score_threshold=0.1),
        Segmenter(),
    )
    for operator in (robot, builder, detector, segmenter):
        operator.setup()
    static: dict[str, Any] = dict(robot.static_outputs())
    static = miscalibrated(static) if rough else static
    frames = []
    for messages in robot.stream():
        m: dict[str, Any] = dict(messages)
        made = builder.process(m["depth"], m["image"], static["depth_info"], static["image_info"], static["extrinsics"])
        cloud = made["cloud"]
        assert isinstance(cloud, PointCloud)
        frames.append(
            Frame(
                detections=detector.process(m["image"]),
                segmentation=segmenter.process(m["image"]),
                cloud=cloud,
                camera=m["ground_truth"],
                base=m["true_base"],
                **{n: m[n] for n in ("objects", "boxes", "masks", "scene", "activities")},
            )
        )
    robot.close()
    return World(f"{kind} {seed}", static["image_info"], static["extrinsics"], frames)


def sensed(seeds: Iterable[int], folder: Path, route: Route = "tour", *, rough: bool = False) -> Iterator[World]:
    """Yields a world of each seed, the kinds in turn; those that the folder has are read from it."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        kind = KINDS[seed % len(KINDS)]
        more = ("" if route == "tour" else f"_{route}") + ("_rough" if rough else "")
        file = folder / f"{kind}_{seed}{more}.pickle"
        if not file.is_file():
            partial = file.with_suffix(".partial")
            partial.write_bytes(pickle.dumps(sense(kind, seed, route, rough=rough)))
            partial.replace(file)
        yield pickle.loads(file.read_bytes())
