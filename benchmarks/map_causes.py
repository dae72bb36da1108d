"""Breaks the misses and the false objects of a map down by cause, step by step from the truth to the map.

    python benchmarks/map_causes.py CACHE [--first 600] [--worlds 10] [--every 1]

Each object that counts and is missed goes to the first step at which it is lost, over the images that show it plainly:
never detected (no box of its class and IoU 0.5), detected as another class, detected in fewer than three images, not
lifted (no 3-D box whose points are mostly its own), lifted in fewer than three images, dropped or never made, not
confirmed, merged with a neighbour of its class, of another class, or of another extent (IoU < 0.25). Each false one is
a double, of another class than what stands there, displaced (there is such a thing, at less than 0.25), or a phantom.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from semantic_map import IOU, PIXELS, VISIBLE, scored
from sensed_worlds import Frame, Mapper, World, sensed

from dataflow.messages import Boxes3D, SceneGraph
from dataflow.messages.geometry import transform_points
from operators.geometry.extrinsics import transform_between
from operators.geometry.pinhole import project
from operators.scene import SemanticMap
from operators.scene.bodies import upright_iou
from operators.scene.scoring import Box, NodeScore, boxes_of
from operators.tracking.assignment import overlap

FEW = 3


@dataclass
class Trail:
    """How often one true object was plainly seen, detected (also as another class), and lifted."""

    seen: int = 0
    detected: int = 0
    other: int = 0
    lifted: int = 0
    boxes: list[float] = field(default_factory=list)


def follow(world: World, every: int, **params: Any) -> tuple[dict[int, Trail], list[SceneGraph], SemanticMap]:
    """Runs lifter and map on what was sensed, and notes what became of every object that was plainly seen."""
    mapper = Mapper(**params)
    trails: dict[int, Trail] = defaultdict(Trail)
    nodes: list[SceneGraph] = []
    for frame in world.frames[::every]:
        found, made = mapper.take(world, frame, frame.detections, frame.segmentation)
        nodes.append(made)
        _note(trails, frame, world, found["boxes"], found["clusters"].labels)
    return trails, nodes, mapper.known


def _note(trails: dict[int, Trail], frame: Frame, world: World, boxes: Boxes3D, labels: Any) -> None:
    true, mine = frame.objects, frame.detections
    assert true.ids is not None
    assert true.visible is not None
    assert true.pixel_counts is not None
    plain = np.flatnonzero((true.visible >= VISIBLE) & (true.pixel_counts >= PIXELS))
    strong = np.flatnonzero(mine.scores >= 0.3)
    shared = overlap(true.boxes[plain].astype(float), mine.boxes[strong].astype(float))
    names, said = true.labels(), mine.labels()
    instance = instances_of(frame, world)
    of_box: dict[int, set[str]] = defaultdict(set)
    for k in range(boxes.count):
        ids, counts = np.unique(instance[labels == k], return_counts=True)
        if len(ids) and counts.max() >= 0.5 * counts.sum():
            of_box[int(ids[np.argmax(counts)])].add(boxes.labels()[k])
    for row, t in enumerate(plain.tolist()):
        trail = trails[int(true.ids[t])]
        hits = {said[strong[j]] for j in np.flatnonzero(shared[row] >= 0.5)}
        trail.seen += 1
        trail.detected += names[t] in hits
        trail.other += bool(hits - {names[t]})
        trail.lifted += names[t] in of_box[int(true.ids[t])]


def instances_of(frame: Frame, world: World) -> Any:
    """Returns the true object of each point of the cloud, -1 outside the image."""
    assert frame.masks.instances is not None
    return _at_points(frame.masks.instances, frame, world)


def classes_of(frame: Frame, world: World) -> Any:
    """Returns the true class of each point of the cloud, -1 outside the image."""
    return _at_points(frame.masks.classes, frame, world)


def _at_points(image: Any, frame: Frame, world: World) -> Any:
    points = frame.cloud.points.astype(float)
    seen = transform_points(transform_between(world.extrinsics, frame.cloud.frame, frame.detections.frame), points)
    with np.errstate(all="ignore"):
        uv = np.nan_to_num(np.rint(project(seen, world.image_info.K)), nan=-1, posinf=-1, neginf=-1).astype(int)
    inside = (uv >= 0).all(axis=1) & (uv < [image.shape[1], image.shape[0]]).all(axis=1) & (seen[:, 2] > 0)
    out = np.full(len(points), -1)
    out[inside] = image[uv[inside, 1], uv[inside, 0]]
    return out


Row = tuple[str, str, tuple[object, ...]]
"""Cause, class, and what else is known."""


def causes(
    world: World, trails: dict[int, Trail], maps: list[SceneGraph], known: SemanticMap
) -> tuple[NodeScore, list[Row]]:
    """Returns the figures of a map, and the cause of every miss and every false object."""
    nodes = maps[-1]
    score = scored(world, nodes)
    true, _ = boxes_of(world.frames[-1].scene)
    mine, labels = boxes_of(nodes)
    rows: list[Row] = []
    for name, i in score.missed:
        trail, box = trails[i], true[i]
        close = 0.5 * float(box[1].max()) + 0.05
        near = [(float(np.linalg.norm(box[0] - mine[m][0])), m) for m in mine if labels[m] == name]
        gap, nearest = min(near, default=(9.0, -1))
        loose = [
            o
            for o in known.entries()
            if o.id not in mine
            and known.classes[o.class_id] == name
            and float(np.linalg.norm(o.center - box[0])) < close
        ]
        if trail.detected == 0:
            cause = "detected as another class" if trail.other else "never detected"
        elif any(labels[m] != name and upright_iou(box, mine[m]) >= IOU for m in mine):
            cause = "of another class"
        elif gap < close and nearest not in score.match:
            cause = "of another extent"
        elif trail.detected < FEW:
            cause = "detected in few images"
        elif trail.lifted < FEW:
            cause = "lifted in few images" if trail.lifted else "not lifted"
        elif loose:
            cause = "not confirmed"
        else:
            cause = "merged with a neighbour" if gap < close else "dropped or elsewhere"
        best = max((upright_iou(box, mine[m]) for m in mine if labels[m] == name), default=0.0)
        counts = (trail.seen, trail.detected, trail.lifted)
        tentative = [(round(o.evidence, 1), o.views) for o in loose]
        extent = (*_told(mine[nearest]), *_told(box)) if gap < close else ()
        rows.append(("missed: " + cause, name, (i, counts, round(best, 2), round(gap, 2), tentative, *extent)))
    rows += [("false: double", name, (i, *_told(mine[i]))) for name, i in score.doubles]
    for name, i, best, gap in score.wrong:
        cause = false_cause(world.frames[-1].scene, mine[i], name)
        rows.append(("false: " + cause, name, (i, best, gap, *_told(mine[i]))))
    return score, rows


def false_cause(truth: SceneGraph, box: Box, name: str) -> str:
    """Returns what a false object of a class is: of another class than what stands there, displaced, or a phantom."""
    true, label = boxes_of(truth)
    stands = {label[t] for t, other in true.items() if t > 0 and upright_iou(other, box) >= 0.2}
    away = (float(np.linalg.norm(true[t][0] - box[0])) for t in true if t > 0 and label[t] == name)
    near_one = min(away, default=9.0) < 0.5 * float(box[1].max()) + 0.2
    return "another class" if stands - {name} else "displaced" if near_one else "phantom"


def _told(box: Box) -> tuple[object, ...]:
    return (np.round(box[0], 2).tolist(), np.round(box[1], 2).tolist(), round(float(np.degrees(box[2]))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    table: Counter[str] = Counter()
    by_class: dict[str, Counter[str]] = defaultdict(Counter)
    every: list[NodeScore] = []
    for world in sensed(range(options.first, options.first + options.worlds), options.cache):
        figures, rows = causes(world, *follow(world, options.every))
        every.append(figures)
        table.update(cause for cause, _, _ in rows)
        for cause, name, more in rows:
            by_class[cause][name] += 1
            if options.verbose:
                print("  ", cause, name, more)
        print(
            f"{world.name}: {figures.must} objects, recall {figures.recall:.3f}, precision "
            f"{figures.precision:.3f}, doubles {len(figures.doubles)}, IoU {np.mean(figures.ious):.2f}, "
            f"ignored {len(figures.ignored)}",
            flush=True,
        )
    print("objects", sum(f.must for f in every))
    for cause, count in sorted(table.items()):
        print(f"{cause}: {count}  {dict(by_class[cause].most_common(6))}")
    for key in ("recall", "precision"):
        values = [getattr(f, key) for f in every]
        print(f"{key}: mean {np.mean(values):.3f}, worst {min(values):.3f}")
    doubles = [len(f.doubles) for f in every]
    print(f"doubles: mean {np.mean(doubles):.1f}, most {max(doubles)}")


if __name__ == "__main__":
    main()
