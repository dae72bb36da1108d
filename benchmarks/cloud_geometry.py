"""Scores planes, clusters and the depth filter against the simulator's truth, world by world.

python benchmarks/cloud_geometry.py --seeds 21 22
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import (
    Boxes3D,
    CameraInfo,
    DepthImage,
    Image,
    Planes,
    PointCloud,
    Pose,
    SegmentationMap,
    Transforms,
)
from operators.cloud import CloudBuilder, CloudFilter, Clusterer, PlaneSegmenter
from operators.cloud.plane_search import covered_area
from operators.depth import DepthFilter
from operators.simulator import SimulatedRobot
from operators.simulator.worlds.make import make_world

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
KINDS = ("floor", "wall", "table")


@dataclass
class Score:
    """Counts of one world."""

    counts: Counter[str] = field(default_factory=Counter)
    milliseconds: dict[str, list[float]] = field(default_factory=dict)

    def share(self, part: str, whole: str) -> str:
        total = self.counts[whole]
        return f"{self.counts[part] / total:.3f} ({self.counts[part]}/{total})" if total else "-"


@dataclass(frozen=True, eq=False)
class TruePlane:
    """A surface as far as a frame shows it: its points, its normal in the world, and whether it must be found."""

    kind: str
    normal: Array
    points: Mask
    due: bool


def walls(world: str, seed: int) -> list[tuple[Array, float, Array, Array]]:
    """(normal, d, lower, upper) of every wall that carries its room, pictures left out."""
    found = []
    for thing in make_world(world, seed, speed=0.5, hold=0.0, movers=True).things:
        if thing.label == "wall":
            face = thing.parts[0][0]
            low, high = face.vertices.min(axis=0), face.vertices.max(axis=0)
            if low[2] < 0.01 and high[2] > 2.0:
                found.append((face.normals[0], -float(face.normals[0] @ face.vertices[0]), low, high))
    return found


def true_planes(
    points: Array, noise: Array, classes: NDArray[Any], instances: NDArray[Any], names: tuple[str, ...],
    boxes: Boxes3D, world_walls: list[tuple[Array, float, Array, Array]],
) -> list[TruePlane]:  # fmt: skip
    """What a frame shows of floor, walls and tables. `points` (N, 3) in the world, `noise` (N,) their tolerance.

    A closed door and the back of a shelf, up to 4 cm before a wall, count as that wall.
    """
    index = {name: k for k, name in enumerate(names)}
    up = np.array([0.0, 0.0, 1.0])
    truth = []

    def add(kind: str, normal: Array, chosen: Mask, area: float, side: float) -> None:
        seen = points[chosen]
        if len(seen) < 50:
            return
        covered = covered_area(seen, normal, 0.1)
        due = len(seen) >= 200 and covered >= area and _side(seen, normal) >= side
        if kind == "wall":
            due &= bool(np.quantile(seen[:, 2], 0.98) >= 1.3)
        truth.append(TruePlane(kind, normal, chosen, due))

    add("floor", up, (classes == index["floor"]) & (np.abs(points[:, 2]) <= noise), 0.3, 0.4)
    upright = np.isin(classes, [index["wall"], index["door"], index["shelf"]])
    gaps = np.full((len(world_walls), len(points)), np.inf)
    for k, (normal, d, low, high) in enumerate(world_walls):
        inside = ((points >= low - noise[:, None] - 0.06) & (points <= high + noise[:, None] + 0.06)).all(axis=1)
        distance = points @ normal + d
        gaps[k] = np.where(inside & (distance <= noise + 0.06) & (distance >= -noise), np.abs(distance), np.inf)
    nearest = gaps.argmin(axis=0)
    for k, (normal, *_) in enumerate(world_walls):
        add("wall", normal, upright & np.isfinite(gaps[k]) & (nearest == k), 0.5, 0.7)
    for k in range(boxes.count):
        if boxes.labels()[k] == "table":
            own = (instances == boxes.ids[k]) & (points[:, 2] > 0.3)  # type: ignore[index]
            if own.sum() >= 50:
                heights, edges = np.histogram(points[own][:, 2], np.arange(0.3, 1.3, 0.02))
                top = float(edges[heights.argmax()]) + 0.01  # a keyboard is part of its table
                add("table", up, own & (np.abs(points[:, 2] - top) <= noise), 0.3, 0.45)
    return truth


def _side(points: Array, normal: Array) -> float:
    """Shortest horizontal side of what is seen."""
    import cv2

    if abs(normal[2]) > 0.5:
        return float(min(cv2.minAreaRect(points[:, :2].astype(np.float32))[1]))
    along = points[:, :2] @ np.array([-normal[1], normal[0]])
    return float(np.ptp(along))


def score_planes(
    score: Score, truth: list[TruePlane], planes: Planes, surfaces: Boxes3D, T: Array, labels: NDArray[np.int32]
) -> None:
    """A plane is right where half of its points are of a true one of its kind, within 10 degrees."""
    right: set[int] = set()
    for true in truth:
        hit = False
        for k, name in enumerate(surfaces.labels()):
            if name != true.kind:
                continue
            cosine = float(T[:3, :3] @ planes.coefficients[k, :3] @ true.normal)
            on = labels == k
            if cosine >= math.cos(math.radians(10)) and (on & true.points).sum() >= 0.5 * on.sum():
                right.add(k)
                hit = True
        if true.due:
            score.counts[f"{true.kind} true"] += 1
            score.counts[f"{true.kind} found"] += hit
    for k, name in enumerate(surfaces.labels()):
        if name in KINDS:
            score.counts[f"{name} said"] += 1
            score.counts[f"{name} right"] += k in right


def score_clusters(
    score: Score, points: Array, instances: NDArray[Any], tables: set[int], labels: NDArray[np.int32], rest: Mask
) -> None:
    """An object is matched where a cluster and its points (those that are on no surface) overlap by half, as IoU.

    It stands free where no other object comes within 12 cm of it in the image's points.
    """
    from scipy.spatial import cKDTree

    ids = [int(i) for i in np.unique(instances[rest]) if i and int(i) not in tables]
    solid = rest & (instances > 0)
    for id in ids:
        own = rest & (instances == id)
        if own.sum() < 60:
            continue
        others = solid & (instances != id)
        free = True
        if others.any():
            free = not np.isfinite(cKDTree(points[others]).query(points[own], distance_upper_bound=0.12)[0]).any()
        hits = np.unique(labels[own])
        best = max((((labels == k) & own).sum() / ((labels == k) | own).sum() for k in hits if k >= 0), default=0.0)
        for group in ("any", "free") if free else ("any",):
            score.counts[f"objects {group}"] += 1
            score.counts[f"objects {group} matched"] += bool(best >= 0.5)


def score_flying(score: Score, fine: DepthImage, noise: float, rng: np.random.Generator) -> None:
    """Flying pixels are made as cameras make them: a pixel is the mean of four rays. Truth is the nearest of the four.

    Scored are those that the mean puts more than 5 % from any of the four.
    """
    height, width = fine.height // 2, fine.width // 2
    rays = fine.data.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4).astype(np.float64)
    seen = (rays > 0).all(axis=2)
    mean = np.where(seen, rays.mean(axis=2), 0)
    off = np.abs(rays - mean[..., None]).min(axis=2)
    hanging = seen & (off > 0.05 * mean)
    inverse = np.where(seen, 1 / np.where(seen, mean, 1), 0) + rng.normal(0, noise, mean.shape)
    measured = np.where(seen, 1 / np.maximum(inverse, 0.05), 0).astype(np.float32)
    operator = DepthFilter()
    operator.setup()
    start = time.perf_counter()
    out = operator.process(DepthImage(stamp=0, frame="camera", data=measured))["filtered"].data
    score.milliseconds.setdefault("filter", []).append((time.perf_counter() - start) * 1e3)

    def error(image: NDArray[np.float32], where: Mask) -> float:
        nearest = np.abs(rays[where] - image[where][:, None]).min(axis=1)
        return float(np.square(nearest).sum())

    kept = hanging & (out > 0)
    calm = seen & ~hanging
    score.counts["flying"] += int(hanging.sum())
    score.counts["flying kept"] += int(kept.sum())
    score.counts["calm"] += int(calm.sum())
    score.counts["calm lost"] += int((calm & (out == 0)).sum())
    for name, image, where in (("before", measured, hanging), ("after", out, kept), ("calm before", measured, calm),
                               ("calm after", out, calm & (out > 0))):  # fmt: skip
        score.counts[f"square {name}"] += error(image, where)  # type: ignore[assignment]


def made_by(builder: CloudBuilder, *given: Any) -> PointCloud:
    cloud = builder.process(*given)["cloud"]
    assert isinstance(cloud, PointCloud)
    return cloud


def numbered(depth: DepthImage) -> NDArray[np.uint8]:
    """Colours (H, W, 3) that are pixel numbers, so that each point of a cloud shows its pixel."""
    rows, columns = np.mgrid[: depth.height, : depth.width]
    number = (rows * depth.width + columns).astype(np.int64)
    return np.stack([number >> 16, (number >> 8) & 255, number & 255], axis=-1).astype(np.uint8)


def pixels_of(coded: PointCloud) -> NDArray[np.int64]:
    """The pixel (N,) of each point of a cloud with such colours."""
    assert coded.colors is not None
    return np.asarray(coded.colors.astype(np.int64) @ [65536, 256, 1], np.int64)


def run(world: str, seed: int, frames: int) -> Score:
    score = Score()
    camera: dict[str, Any] = {"rate": 1.0}
    truth_of: dict[str, Any] = {"poses": 1.0, "masks": True, "relations": 0.0, "activities": 0.0}
    robot = SimulatedRobot(
        world=world, seed=seed, duration=f"{frames}s", color_camera=camera, depth_camera=camera, truth=truth_of
    )
    robot.setup()
    info = robot.static_outputs()["depth_info"]
    image_info = robot.static_outputs()["image_info"]
    assert isinstance(info, CameraInfo)
    assert isinstance(image_info, CameraInfo)
    builder = CloudBuilder(stride=2, max_range=5.0, edge_ratio=0.05)
    segmenter, clusterer, thinner = PlaneSegmenter(), Clusterer(), CloudFilter(voxel=0.03, normal_neighbours=16)
    for operator in (builder, segmenter, clusterer, thinner):
        operator.setup()
    world_walls = walls(world, seed)
    extrinsics = robot.static_outputs()["extrinsics"]
    assert isinstance(extrinsics, Transforms)
    for k, messages in enumerate(robot.stream()):
        depth, image, pose, masks, boxes = (
            messages[name] for name in ("depth", "image", "ground_truth", "masks", "boxes")
        )
        assert isinstance(depth, DepthImage)
        assert isinstance(image, Image)
        assert isinstance(pose, Pose)
        assert isinstance(masks, SegmentationMap)
        assert isinstance(boxes, Boxes3D)
        assert masks.instances is not None
        cloud = made_by(builder, depth, image, info, image_info, extrinsics)
        pixel = pixels_of(made_by(builder, depth, image.replace(data=numbered(depth)), info, image_info))
        classes, instances = masks.classes.ravel()[pixel], masks.instances.ravel()[pixel]
        segmenter.seed_rng(k)
        start = time.perf_counter()
        found = segmenter.process(cloud, pose)
        middle = time.perf_counter()
        grouped = clusterer.process(found["rest"], pose)
        end = time.perf_counter()
        thinner.process(cloud)
        score.milliseconds.setdefault("thin", []).append((time.perf_counter() - end) * 1e3)
        score.milliseconds.setdefault("planes", []).append((middle - start) * 1e3)
        score.milliseconds.setdefault("clusters", []).append((end - middle) * 1e3)
        T = pose.matrix()
        sensor = cloud.points.astype(np.float64)
        in_world = sensor @ T[:3, :3].T + T[:3, 3]
        noise = 0.02 + 0.003 * (sensor**2).sum(axis=1)
        truth = true_planes(in_world, noise, classes, instances, masks.class_names, boxes, world_walls)
        score_planes(score, truth, found["planes"], found["surfaces"], T, found["planes"].labels)
        surface = np.array([name != "other" for name in found["surfaces"].labels()] + [False])
        left = ~surface[found["planes"].labels]
        labels = np.full(cloud.count, -1, np.int32)
        labels[left] = grouped["clusters"].labels
        tables = {int(i) for i, name in zip(boxes.ids, boxes.labels(), strict=True) if name == "table"}  # type: ignore[arg-type]
        score_clusters(score, in_world, instances, tables, labels, left)
    _flying(score, world, seed, frames)
    return score


def _flying(score: Score, world: str, seed: int, frames: int) -> None:
    fine = {"rate": 1.0, "width": 640, "height": 480, "noise": 0.0, "quantum": 0.0002, "edge_holes": 0.0, "specks": 0.0}
    robot = SimulatedRobot(
        world=world, seed=seed, duration=f"{min(frames, 5)}s", color_camera={"rate": 0.0}, depth_camera=fine,
        truth={"poses": 0.0, "boxes": False, "relations": 0.0, "activities": 0.0},
    )  # fmt: skip
    robot.setup()
    rng = np.random.default_rng(seed)
    for messages in robot.stream():
        depth = messages["depth"]
        assert isinstance(depth, DepthImage)
        score_flying(score, depth, 0.0015, rng)


def _row(name: str, score: Score) -> str:
    pairs = [(f"{kind} {a}", f"{kind} {b}") for kind in KINDS for a, b in (("found", "true"), ("right", "said"))]
    pairs += [(f"objects {group} matched", f"objects {group}") for group in ("any", "free")]
    return f"| {name} | " + " | ".join(score.share(*pair) for pair in pairs) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    parser.add_argument("--worlds", nargs="+", default=["office", "corridor", "table_top"])
    parser.add_argument("--frames", type=int, default=6)
    arguments = parser.parse_args()
    columns = [f"{kind} {what}" for kind in KINDS for what in ("recall", "precision")]
    print("| world | " + " | ".join(columns) + " | objects | of them free |\n" + "| --- " * 9 + "|")
    total, scores = Score(), {}
    for world in arguments.worlds:
        for seed in arguments.seeds:
            score = scores[f"{world} {seed}"] = run(world, seed, arguments.frames)
            print(_row(f"{world} {seed}", score), flush=True)
            total.counts.update(score.counts)
            for name, values in score.milliseconds.items():
                total.milliseconds.setdefault(name, []).extend(values)
    scores["all"] = total
    print(_row("all", total))
    print("\n| world | flying pixels | lost | RMSE before | after | RMSE elsewhere before | after | lost elsewhere |")
    print("| --- " * 8 + "|")
    for name, score in scores.items():
        c = score.counts
        sums = (("before", "flying"), ("after", "flying kept"), ("calm before", "calm"), ("calm after", "calm"))
        rms = [math.sqrt(c[f"square {a}"] / max(1, c[b])) for a, b in sums]
        print(f"| {name} | {c['flying']} | {c['flying'] - c['flying kept']} | " + " | ".join(f"{v:.3f}" for v in rms)
              + f" | {c['calm lost'] / max(1, c['calm']):.5f} |")  # fmt: skip
    print("\n| step | median ms | worst |\n| --- | --- | --- |")
    for name, values in total.milliseconds.items():
        print(f"| {name} | {np.median(values):.0f} | {max(values):.0f} |")


if __name__ == "__main__":
    main()
