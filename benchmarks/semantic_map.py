"""The map of objects against truth after a drive through simulated worlds, from sensors only and fed with truth.

    python benchmarks/semantic_map.py CACHE [--first 600] [--worlds 12]

From sensors: the shipped detector and segmenter, a depth camera, true camera poses. Fed with truth: true boxes and
masks in place of the networks'. An object counts that was at least 60 % visible, with at least 200 pixels, in 5 images
or more; others are ignored: neither a miss nor, where the map has them, a false one. Movers count where they were in
view in the last 2 s.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from sensed_worlds import Mapper, World, in_view, sensed

from dataflow.messages import Detections2D, SceneGraph, SegmentationMap
from operators.recognition.activity.tracked_people import simulated_labels
from operators.scene.scoring import NodeScore, VisibleImages, score_nodes

IOU, VISIBLE, PIXELS, IMAGES = 0.25, 0.6, 200, 5


def mapped(world: World, *, true: bool, **params: Any) -> list[SceneGraph]:
    """Returns the map after each frame."""
    mapper = Mapper(**params)
    nodes: list[SceneGraph] = []
    for frame in world.frames:
        detections: Detections2D = frame.objects if true else frame.detections
        masks: SegmentationMap = frame.masks if true else frame.segmentation
        if true:
            detections = chosen(frame.objects, in_view(frame.objects, 0.2, 100))
        nodes.append(mapper.take(world, frame, detections, masks)[1])
    return nodes


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


def plainly_seen() -> VisibleImages:
    return VisibleImages(VISIBLE, PIXELS, IMAGES)


def seen(world: World) -> VisibleImages:
    counts = plainly_seen()
    for frame in world.frames:
        counts.add(frame.objects)
    return counts


def scored(world: World, nodes: SceneGraph) -> NodeScore:
    """Scores a map at the end of the drive; movers count that were in view in the last 2 s."""
    truth = world.frames[-1].scene
    return score_nodes(nodes, truth, seen(world).must(truth, simulated_labels()), IOU)


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
            result = scored(world, mapped(world, true=true)[-1])
            figures[true].append(result)
            print(
                f"{world.name} {'truth-fed' if true else 'sensors'}: {result.must} objects, "
                f"recall {result.recall:.2f}, precision {result.precision:.2f}, "
                f"doubles {len(result.doubles)}, IoU {np.mean(result.ious):.2f}",
                flush=True,
            )
            if options.verbose:
                print("   missed", result.missed, "\n   wrong", result.wrong, "\n   doubles", result.doubles)
    for true, rows in figures.items():
        for key in ("recall", "precision"):
            values = [getattr(r, key) for r in rows]
            print(f"{'truth-fed' if true else 'sensors'} {key}: mean {np.mean(values):.3f}, worst {min(values):.3f}")


if __name__ == "__main__":
    main()
