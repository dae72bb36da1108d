"""Boxes in space of single images, by ObjectLifter, beside those of the map at the same time, against truth.

    python benchmarks/frame_boxes.py CACHE [--first 605] [--worlds 5]

The worlds of `semantic_map.py`. In each image an object counts that is at least 60 % visible in it, with at least 200
pixels; a box is right that has its class and an IoU of 0.25 with the whole true box. Others are ignored: no miss, and
no false box where one is put on them. *Sensors*: the shipped networks and the depth camera; *true boxes*: the true
boxes and masks of the image in place of the networks'; *map*: which of the same objects the map has after the image.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from semantic_map import IOU, PIXELS, VISIBLE, chosen
from sensed_worlds import Frame, Mapper, World, sensed

from dataflow.messages import Boxes3D, SceneGraph
from dataflow.messages.geometry import matrix_to_quaternion, quaternion_to_matrix, transform_points
from operators.geometry.extrinsics import transform_between
from operators.scene import ObjectLifter
from operators.scene.scoring import NodeScore, score_nodes


def in_world(boxes: Boxes3D, frame: Frame, world: World) -> SceneGraph:
    """Returns boxes of a cloud as nodes in the world; their ids count from 1."""
    T = frame.camera.matrix() @ transform_between(
        world.extrinsics, boxes.frame, frame.camera.child_frame or boxes.frame
    )
    axes = np.tile(np.eye(4), (boxes.count, 1, 1))
    axes[:, :3, :3] = T[:3, :3] @ quaternion_to_matrix(boxes.orientations).reshape(-1, 3, 3)
    none = np.zeros(0, np.int32)
    return SceneGraph(
        stamp=boxes.stamp,
        frame=frame.camera.frame,
        class_names=boxes.class_names,
        ids=np.arange(1, boxes.count + 1),
        class_ids=boxes.class_ids,
        positions=transform_points(T, boxes.centers).reshape(-1, 3),
        sizes=boxes.sizes,
        orientations=matrix_to_quaternion(axes),
        scores=boxes.scores,
        subjects=none,
        objects=none,
    )


def plain(frame: Frame) -> set[int]:
    """Returns the ids of the objects that count in an image."""
    objects = frame.objects
    assert objects.ids is not None
    assert objects.visible is not None
    assert objects.pixel_counts is not None
    return set(objects.ids[(objects.visible >= VISIBLE) & (objects.pixel_counts >= PIXELS)].tolist())


def scores(world: World) -> Iterator[dict[str, NodeScore]]:
    """Yields the figures of each image: boxes from sensors, boxes from true boxes and masks, the map."""
    mapper, lifter = Mapper(), ObjectLifter(labels="simulator")
    lifter.setup()
    for frame in world.frames:
        must = plain(frame)
        found, nodes = mapper.take(world, frame, frame.detections, frame.segmentation)
        objects = frame.objects
        assert objects.visible is not None
        assert objects.pixel_counts is not None
        true = chosen(objects, (objects.visible >= 0.2) & (objects.pixel_counts >= 100))
        fed = lifter.process(true, frame.cloud, world.image_info, world.extrinsics, frame.masks, frame.camera)
        yield {
            "sensors": score_nodes(in_world(found["boxes"], frame, world), frame.scene, must, IOU),
            "true boxes": score_nodes(in_world(fed["boxes"], frame, world), frame.scene, must, IOU),
            "map": score_nodes(nodes, frame.scene, must, IOU),
        }


def shares(counts: Counter[str]) -> tuple[float, float]:
    """Returns recall and precision."""
    found = counts["found"]
    return found / max(counts["must"], 1), found / max(found + counts["false"], 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--first", type=int, default=605)
    parser.add_argument("--worlds", type=int, default=5)
    options = parser.parse_args()
    by_class: Counter[tuple[str, str]] = Counter()
    worlds: dict[str, list[tuple[float, float]]] = {}
    for world in sensed(range(options.first, options.first + options.worlds), options.cache):
        sums: dict[str, Counter[str]] = {}
        for images in scores(world):
            for source, score in images.items():
                counts = sums.setdefault(source, Counter())
                counts["must"] += score.must
                counts["found"] += score.found
                counts["false"] += len(score.doubles) + len(score.wrong)
                counts["matched"] += len(score.ious)
                counts["iou"] += round(1e6 * sum(score.ious))
                if source == "sensors":
                    by_class.update(("missed", name) for name, _ in score.missed)
                    by_class.update(("false", str(wrong[0])) for wrong in [*score.doubles, *score.wrong])
        for source, counts in sums.items():
            recall, precision = shares(counts)
            iou = counts["iou"] / 1e6 / max(counts["matched"], 1)
            right = "" if source == "map" else f"precision {precision:.3f}, "  # the map has what is not in view, too
            print(f"{world.name} {source}: recall {recall:.3f}, {right}IoU {iou:.2f} ({counts['must']})", flush=True)
            worlds.setdefault(source, []).append((recall, precision))
    for source, rows in worlds.items():
        recalls, precisions = zip(*rows, strict=True)
        right = "" if source == "map" else f"; precision mean {np.mean(precisions):.3f}, worst {min(precisions):.3f}"
        print(f"{source}: recall mean {np.mean(recalls):.3f}, worst {min(recalls):.3f}{right}")
    for kind in ("missed", "false"):
        most = [(name, n) for (k, name), n in by_class.most_common() if k == kind]
        print(f"{kind}, from sensors: " + ", ".join(f"{n} {name}" for name, n in most))


if __name__ == "__main__":
    main()
