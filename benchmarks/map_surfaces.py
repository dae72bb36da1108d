"""Floor, walls and table tops of the map against truth, and what stands on them, after drives in simulated worlds.

    python benchmarks/map_surfaces.py CACHE [--first 600] [--worlds 10]

A depth camera and true camera poses; a cloud every other second is searched for planes. A true surface counts that was
seen so far: a wall with 1 m² and 1.2 m above the floor, a table top with 0.25 m², in three clouds or more. A surface of
the map is right that is of its class and whose box, made 0.3 m thick, has an IoU of 0.25 or more with the box of what
was seen of the true one; surfaces of which less was seen are ignored.
"""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from map_causes import classes_of, instances_of
from numpy.typing import NDArray
from sensed_worlds import KINDS, Frame, Mapper, World, sensed

from dataflow.messages import SceneGraph
from dataflow.messages.geometry import transform_points
from operators.geometry.extrinsics import transform_between
from operators.scene import SceneGraphBuilder
from operators.scene.bodies import shared_volume, upright_iou
from operators.scene.map.voxels import VoxelSet
from operators.scene.scoring import Box, boxes_of, match_nodes
from operators.simulator.worlds.make import make_world

Array = NDArray[np.float64]
THICK, IOU, VIEWS, SIDE = 0.3, 0.25, 3, 0.1
CLASSES = ("floor", "wall", "tabletop")


@dataclass(frozen=True)
class Sheet:
    """A true surface as far as it was seen; `id` is that of its table, 0 for others."""

    label: str
    box: Box
    due: bool
    id: int = 0


@dataclass
class Figures:
    """Counts by class, overlaps, distances between planes (m), and relations `on` a surface."""

    counts: Counter[str] = field(default_factory=Counter)
    ious: list[float] = field(default_factory=list)
    apart: list[float] = field(default_factory=list)

    def told(self, label: str) -> str:
        hit, miss, double, false = (self.counts[f"{label} {k}"] for k in ("hit", "miss", "double", "false"))
        return (
            f"{label}: recall {hit / max(hit + miss, 1):.2f} ({hit} of {hit + miss}), "
            f"precision {hit / max(hit + double + false, 1):.2f}, doubles {double}, false {false}"
        )

    def on(self, what: str) -> str:
        hit, false, miss = (self.counts[f"on {what} {k}"] for k in ("hit", "false", "miss"))
        return f"on {what}: F1 {2 * hit / max(2 * hit + false + miss, 1):.3f} of {hit + miss}"


def mapped(world: World) -> tuple[list[SceneGraph], list[SceneGraph]]:
    """Returns the map, and the graph built on it, once a second."""
    mapper, builder = Mapper(), SceneGraphBuilder(labels="simulator")
    builder.setup()
    maps, graphs = [], []
    for k, frame in enumerate(world.frames):
        nodes = mapper.take(world, frame, frame.detections, frame.segmentation)[1]
        graph = builder.process(nodes, frame.base)["graph"]
        if k % 4 == 0:
            maps.append(nodes)
            graphs.append(graph)
    return maps, graphs


def walls(world: World) -> list[tuple[Array, Array]]:
    """The two lower corners (2, 3) of each wall that carries its room, and the direction (3,) into the room."""
    kind, seed = world.name.split()
    made = make_world(kind, int(seed), speed=0.5, hold=0.0, movers=True, people=3, tour=True)
    faces = [thing.parts[0][0] for thing in made.things if thing.label == "wall"]
    whole = [f for f in faces if f.vertices[:, 2].min() < 0.01 and f.vertices[:, 2].max() > 2.0]
    return [(f.vertices, f.normals[0]) for f in whole]


def truth(world: World) -> list[Sheet]:
    """The surfaces of a world as far as clouds show them."""
    seen: dict[tuple[str, int], VoxelSet] = {}
    sheets = walls(world)
    names: dict[int, str] = {}
    for frame in world.frames[::4]:
        points, classes, instances = _labelled(frame, world)
        boxes, labels = boxes_of(frame.scene)
        names |= labels
        shown = {("floor", 0): points[classes == "floor"]}
        for k, (corners, normal) in enumerate(sheets):
            low, high = corners.min(axis=0) - 0.05, corners.max(axis=0) + 0.05
            on = (classes == "wall") & ((points >= low) & (points <= high)).all(axis=1)
            shown["wall", k] = points[on & (np.abs((points - corners[0]) @ normal) < 0.05)]
        for i in np.unique(instances).tolist():
            if labels.get(i) == "table":
                own = points[instances == i]
                shown["tabletop", i] = own[np.abs(own[:, 2] - boxes[i][0][2] - boxes[i][1][2] / 2) < 0.03]
        for key, own in shown.items():
            if len(own):
                seen.setdefault(key, VoxelSet(SIDE)).add(VoxelSet.of(own, SIDE))
    last = boxes_of(world.frames[-1].scene)[0]
    return [made for (label, k), voxels in seen.items() if (made := _true(label, k, voxels, sheets, last)) is not None]


def _labelled(frame: Frame, world: World) -> tuple[Array, NDArray[np.str_], NDArray[np.int64]]:
    """Points in the world with their true classes and instances."""
    sensor = frame.camera.child_frame or frame.cloud.frame
    T = frame.camera.matrix() @ transform_between(world.extrinsics, frame.cloud.frame, sensor)
    classes, instances = classes_of(frame, world), instances_of(frame, world)
    names = np.array([*frame.masks.class_names, ""])
    named = names[np.where((classes >= 0) & (classes < len(names) - 1), classes, len(names) - 1)]
    return transform_points(T, frame.cloud.points.astype(float)), named, instances


def _true(
    label: str, k: int, voxels: VoxelSet, sheets: list[tuple[Array, Array]], boxes: dict[int, Box]
) -> Sheet | None:
    points = voxels.points[voxels.hits >= VIEWS]
    if len(points) < 5:
        return None
    if label == "wall":
        corners, normal = sheets[k]
        along = np.array([-normal[1], normal[0], 0.0])
        ends = np.percentile((points - corners[0]) @ along, [1, 99])
        low, high = np.percentile(points[:, 2], [1, 99])
        center = corners[0] + along * ends.mean()
        center[2] = (low + high) / 2
        size = np.array([np.ptp(ends), THICK, high - low])
        flat = np.stack([(points - corners[0]) @ along, points[:, 2]], axis=1)
        due = _area(flat) >= 1.0 and np.ptp(ends) >= 0.6 and high >= 1.2
        return Sheet(label, (center, size, float(np.arctan2(along[1], along[0]))), bool(due))
    if label == "floor":
        low, high = points.min(axis=0), points.max(axis=0)
        center, size = (low + high) / 2, high - low
        return Sheet(label, (np.array([*center[:2], 0.0]), np.array([*size[:2], THICK]), 0.0), True)
    center, size, yaw = boxes[k]
    top = center + np.array([0.0, 0.0, size[2] / 2])
    return Sheet(label, (top, np.array([*size[:2], THICK]), yaw), _area(points[:, :2]) >= 0.25, k)


def _area(flat: Array) -> float:
    return len(np.unique(np.floor(flat / SIDE).astype(int), axis=0)) * SIDE * SIDE


def _thick(label: str, box: Box) -> Box:
    center, size, yaw = box
    return center, np.array([size[0], THICK, size[2]] if label == "wall" else [size[0], size[1], THICK]), yaw


def _apart(label: str, mine: Box, true: Box) -> float:
    way = mine[0] - true[0]
    return float(abs(way @ [-np.sin(true[2]), np.cos(true[2]), 0]) if label == "wall" else abs(way[2]))


def scored(nodes: SceneGraph, true: list[Sheet], figures: Figures, verbose: bool) -> dict[int, Sheet]:
    """Counts what is right; returns the true surface of each one that is."""
    mine, labels = boxes_of(nodes)
    boxes = {i: _thick(labels[i], box) for i, box in mine.items() if labels[i] in CLASSES and i <= 0}
    rows = sorted(
        ((upright_iou(boxes[i], t.box), i, k) for i in boxes for k, t in enumerate(true) if t.label == labels[i]),
        reverse=True,
    )
    of: dict[int, int] = {}
    for iou, i, k in rows:
        if iou >= IOU and i not in of and k not in of.values():
            of[i] = k
            if true[k].due:
                figures.counts[f"{labels[i]} hit"] += 1
                figures.ious.append(iou)
                figures.apart.append(_apart(labels[i], mine[i], true[k].box))
    for i, box in boxes.items():
        if i in of:
            continue
        near = [k for k, t in enumerate(true) if t.label == labels[i] and upright_iou(box, t.box) > 0.02]
        kind = "false" if not near else "double" if any(k in of.values() or true[k].due for k in near) else "ignored"
        figures.counts[f"{labels[i]} {kind}"] += 1
        if verbose and kind != "ignored":
            print("  ", kind, labels[i], i, *(np.round(v, 2) for v in box))
    for k, t in enumerate(true):
        if t.due and k not in of.values():
            figures.counts[f"{t.label} miss"] += 1
            if verbose:
                best = max((upright_iou(box, t.box) for i, box in boxes.items() if labels[i] == t.label), default=0)
                print("   miss", t.label, *(np.round(v, 2) for v in t.box), round(best, 2))
    return {i: true[k] for i, k in of.items()}


def stands(graph: SceneGraph, scene: SceneGraph, of: dict[int, Sheet], figures: Figures) -> None:
    """Counts relations `on` of mapped objects and surfaces; tables whose tops are flush are one surface."""
    match = match_nodes(graph, scene)
    ids, true_ids = graph.ids.tolist(), scene.ids.tolist()
    boxes = boxes_of(graph)[0]
    tables = _tables(scene)
    tops = {i: box for i, box in boxes_of(scene)[0].items() if i in tables}
    covers = {i: {t for t, box in tops.items() if _covers(boxes[i], box)} for i in of if i < 0 and i in boxes} | {
        0: {0}
    }
    true = {(true_ids[s], true_ids[o]) for s, p, o in scene.relations() if p == "on"}
    found: set[tuple[int, int]] = set()
    for s, p, o in graph.relations():
        if p != "on" or ids[s] not in match or ids[o] not in covers:
            continue
        right = {(match[ids[s]], t) for t in covers[ids[o]]} & true
        figures.counts[f"on {'tabletops' if ids[o] else 'floor'} {'hit' if right else 'false'}"] += 1
        found |= right
    known = set().union(*covers.values())
    for s, o in true - found:
        if s in match.values() and o in known:
            figures.counts[f"on {'tabletops' if o else 'floor'} miss"] += 1


def _tables(scene: SceneGraph) -> set[int]:
    return {i for i, label in boxes_of(scene)[1].items() if label == "table"}


def _covers(top: Box, table: Box) -> bool:
    """Returns whether half of a table's footprint is under a surface at its height."""
    high = table[0][2] + table[1][2] / 2
    flat = (np.array([*table[0][:2], 0]), np.array([*table[1][:2], 1.0]), table[2])
    own = (np.array([*top[0][:2], 0]), np.array([*top[1][:2], 1.0]), top[2])
    return abs(high - top[0][2]) < 0.1 and shared_volume(own, flat) >= 0.5 * float(np.prod(flat[1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument("--worlds", type=int, default=len(KINDS))
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    every = Figures()
    for world in sensed(range(options.first, options.first + options.worlds), options.cache):
        maps, graphs = mapped(world)
        own = Figures()
        of = scored(maps[-1], truth(world), own, options.verbose)
        for k in range(len(graphs) // 2, len(graphs)):
            stands(graphs[k], world.frames[4 * k].scene, of, own)
        print(
            world.name, "; ".join([*(own.told(c) for c in CLASSES), own.on("floor"), own.on("tabletops")]), flush=True
        )
        every.counts.update(own.counts)
        every.ious += own.ious
        every.apart += own.apart
    for label in CLASSES:
        print(every.told(label))
    print(every.on("floor"))
    print(every.on("tabletops"))
    apart = f"median {np.median(every.apart):.3f} m, most {max(every.apart):.3f}"
    print(f"IoU mean {np.mean(every.ious):.2f}; planes apart, {apart}")


if __name__ == "__main__":
    main()
