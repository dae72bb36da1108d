"""The map of objects against truth after a drive through simulated worlds, from sensors only and fed with truth.

    python benchmarks/semantic_map.py CACHE [--first 600] [--worlds 12]

From sensors: the shipped detector and segmenter, a depth camera, true camera poses. Fed with truth: true boxes and
masks in place of the networks'. An object counts that was at least 60 % visible, with at least 200 pixels, in 5 images
or more; others are ignored: neither a miss nor, where the map has them, a false one. Movers count where they were in
view in the last 2 s.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from sensed_worlds import World, sensed

from dataflow.messages import Boxes3D, Detections2D, SceneGraph, SegmentationMap
from dataflow.messages.geometry import yaw_of
from operators.scene import ObjectLifter, SemanticMap
from operators.scene.box_overlap import upright_iou

IOU, VISIBLE, PIXELS, IMAGES = 0.25, 0.6, 200, 5


def mapped(world: World, *, true: bool, **params: Any) -> tuple[list[Boxes3D], list[SceneGraph]]:
    """Returns the map after each frame, as boxes and as nodes."""
    lifter, known = ObjectLifter(), SemanticMap(**params)
    lifter.setup()
    known.setup()
    maps, nodes = [], []
    for frame in world.frames:
        detections: Detections2D = frame.objects if true else frame.detections
        masks: SegmentationMap = frame.masks if true else frame.segmentation
        if true:
            enough = (frame.objects.visible >= 0.2) & (frame.objects.pixel_counts >= 100)
            detections = chosen(frame.objects, enough)
        found = lifter.process(detections, frame.cloud, world.image_info, world.extrinsics, masks, frame.camera)
        made = known.process(
            found["boxes"],
            found["clusters"],
            frame.cloud,
            frame.camera,
            world.extrinsics,
            found["images"],
            world.image_info,
        )
        maps.append(made["objects"])
        nodes.append(made["nodes"])
    return maps, nodes


def chosen(objects: Detections2D, rows: Any) -> Detections2D:
    return Detections2D(
        stamp=objects.stamp,
        frame=objects.frame,
        width=objects.width,
        height=objects.height,
        class_names=objects.class_names,
        boxes=objects.boxes[rows],
        scores=objects.scores[rows],
        class_ids=objects.class_ids[rows],
    )


def countable(world: World) -> set[int]:
    seen: Counter[int] = Counter()
    for frame in world.frames:
        clear = (frame.objects.visible >= VISIBLE) & (frame.objects.pixel_counts >= PIXELS)
        seen.update(frame.objects.ids[clear].tolist())
    return {i for i, n in seen.items() if n >= IMAGES}


def solids(centers: Any, sizes: Any, orientations: Any) -> list[tuple[Any, Any, float]]:
    yaws = yaw_of(orientations) if len(centers) else np.zeros(0)
    return list(zip(np.asarray(centers), np.asarray(sizes), yaws.tolist(), strict=True))


def scored(world: World, known: Boxes3D) -> dict[str, Any]:
    """Matches the map with the truth at its end, class by class, best overlap first."""
    truth, counts = world.frames[-1].scene, countable(world)
    last_view = {i: f.objects.stamp for f in world.frames for i in f.objects.ids.tolist()}
    names = [truth.class_names[c] for c in truth.class_ids.tolist()]
    movers = {"person", "robot", "ball"}
    rows = [k for k in range(truth.count) if truth.ids[k] > 0]
    recent = truth.stamp - 2_000_000_000
    must = {
        k
        for k in rows
        if int(truth.ids[k]) in counts and (names[k] not in movers or last_view[int(truth.ids[k])] >= recent)
    }
    true = solids(truth.positions, truth.sizes, truth.orientations)
    mine = solids(known.centers, known.sizes, known.orientations)
    labels = known.labels()
    pairs = sorted(
        ((upright_iou(true[t], mine[m]), t, m) for t in rows for m in range(known.count) if names[t] == labels[m]),
        reverse=True,
    )
    of_truth: dict[int, int] = {}
    of_mine: dict[int, int] = {}
    for value, t, m in pairs:
        if value >= IOU and t not in of_truth and m not in of_mine:
            of_truth[t], of_mine[m] = m, t
    doubles, wrong, ignored = [], [], 0
    for m in range(known.count):
        if m in of_mine:
            continue
        best = max(((upright_iou(true[t], mine[m]), t) for t in rows if names[t] == labels[m]), default=(0.0, -1))
        gaps = [(float(np.linalg.norm(true[t][0] - mine[m][0])), t) for t in rows if names[t] == labels[m]]
        gap, nearest = min(gaps, default=(9.0, -1))
        if (
            gap < 0.5 * float(mine[m][1].max()) + 0.2
            and nearest >= 0
            and nearest not in must
            and nearest not in of_truth
        ):
            ignored += 1
        elif gap < 0.5 and nearest in of_truth:
            doubles.append((labels[m], round(best[0], 2)))
        else:
            wrong.append((labels[m], int(known.ids[m]), round(best[0], 2), round(gap, 2)))
    hits = sum(t in of_truth for t in must)
    counted = len([m for m, t in of_mine.items() if t in must])
    false = len(doubles) + len(wrong)
    return {
        "must": len(must),
        "recall": hits / max(len(must), 1),
        "precision": counted / max(counted + false, 1),
        "doubles": doubles,
        "wrong": wrong,
        "missed": [(names[t], int(truth.ids[t])) for t in sorted(must) if t not in of_truth],
        "ious": [value for value, t, m in pairs if of_truth.get(t) == m],
        "match": {int(known.ids[m]): int(truth.ids[t]) for m, t in of_mine.items()},
        "ignored": ignored,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    figures: dict[bool, list[Any]] = {True: [], False: []}
    for world in sensed(range(options.first, options.first + options.worlds), options.cache):
        for true in (True, False):
            result = scored(world, mapped(world, true=true)[0][-1])
            figures[true].append(result)
            print(
                f"{world.name} {'truth-fed' if true else 'sensors'}: {result['must']} objects, "
                f"recall {result['recall']:.2f}, precision {result['precision']:.2f}, "
                f"doubles {len(result['doubles'])}, IoU {np.mean(result['ious']):.2f}",
                flush=True,
            )
            if options.verbose:
                print("   missed", result["missed"], "\n   wrong", result["wrong"], "\n   doubles", result["doubles"])
    for true, rows in figures.items():
        for key in ("recall", "precision"):
            values = [r[key] for r in rows]
            print(f"{'truth-fed' if true else 'sensors'} {key}: mean {np.mean(values):.3f}, worst {min(values):.3f}")


if __name__ == "__main__":
    main()
