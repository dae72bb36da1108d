"""Causes of the missing and the false relations of a scene graph, over all.

    python benchmarks/relation_causes.py CACHE --seeds 506 509

From sensors, as scene_graph.py, at every second of the last half of the drive. A true relation between objects that are
plainly seen at some time of the drive, which is not told, goes to the first that holds of either end: it is not plainly
seen yet, it moves by itself and is out of view, its object is missed at the end too, its object is not right yet; else
both are mapped. A false one goes to its false node: a double, of another class than what stands there, displaced, or a
phantom; else both are mapped.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from map_causes import false_cause
from semantic_map import mapped, plainly_seen, seen
from sensed_worlds import Frame, World, sensed

from dataflow.messages import SceneGraph
from operators.recognition.activity.tracked_people import simulated_labels
from operators.scene import SceneGraphBuilder
from operators.scene.relations import FLOOR
from operators.scene.scoring import boxes_of, ordered, score_nodes, triples

Causes = dict[str, Counter[str]]
"""Relations by cause and by what they hang on: a class, or the predicate where both nodes are mapped."""


def causes(world: World) -> Causes:
    """Returns what the relations of one world that are lost or false are made of; `right` are the others."""
    nodes = mapped(world, true=False)
    builder = SceneGraphBuilder(labels="simulator")
    builder.setup()
    whole, counts = seen(world).countable(), plainly_seen()
    at_end = set(score_nodes(nodes[-1], world.frames[-1].scene, whole).match.values())
    found: Causes = defaultdict(Counter)
    for k, (frame, node) in enumerate(zip(world.frames, nodes, strict=True)):
        graph = builder.process(node, frame.base)["graph"]
        counts.add(frame.objects)
        if k >= len(nodes) // 2 and k % max(1, round(len(nodes) / 50)) == 0:
            _lost(found, graph, frame, whole, counts.must(frame.scene, simulated_labels()), at_end)
            _false(found, graph, frame, whole)
    return found


def _lost(found: Causes, graph: SceneGraph, frame: Frame, whole: set[int], must: set[int], at_end: set[int]) -> None:
    of = score_nodes(graph, frame.scene, whole).match | {FLOOR: FLOOR}
    _, names = boxes_of(frame.scene)
    mine = {ordered((of[s], p, of[o])) for s, p, o in triples(graph) if s in of and o in of}
    for s, p, o in {ordered(t) for t in triples(frame.scene)}:
        if not {s, o} <= whole | {FLOOR}:
            continue
        if (s, p, o) in mine:
            found["right"][p] += 1
            continue
        lacking = [i for i in (s, o) if i not in of.values()]
        causes = sorted(
            (2 if "agent" in simulated_labels().roles(names[i]) else 1, names[i])
            if i not in must
            else (4 if i in at_end else 3, names[i])
            for i in lacking
        )
        rank, name = causes[0] if causes else (5, p)
        cause = ("seen later", "mover out of view", "object missed", "object not right yet", "both mapped")[rank - 1]
        found["lost: " + cause][name] += 1


def _false(found: Causes, graph: SceneGraph, frame: Frame, whole: set[int]) -> None:
    score = score_nodes(graph, frame.scene, whole)
    of = score.match | {FLOOR: FLOOR}
    mine, labels = boxes_of(graph)
    true = {ordered(t) for t in triples(frame.scene)}
    beside = {*score.ignored, *(node for node, thing in of.items() if thing not in whole | {FLOOR})}
    doubles = {i for _, i in score.doubles}
    for s, p, o in triples(graph):
        strange = [i for i in (s, o) if i not in of]
        if {s, o} & beside:
            continue
        if strange:
            kinds = sorted(
                ("double" if i in doubles else false_cause(frame.scene, mine[i], labels[i]), i) for i in strange
            )
            found["false: " + kinds[0][0]][labels[kinds[0][1]]] += 1
        elif ordered((of[s], p, of[o])) not in true:
            found["false: both mapped"][p] += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    options = parser.parse_args()
    total: Causes = defaultdict(Counter)
    for seed in options.seeds:
        for world in sensed([seed], options.cache):
            for cause, counts in causes(world).items():
                total[cause] += counts
            print(world.name, flush=True)
    every = np.sum([sum(counts.values()) for counts in total.values()])
    for cause, counts in sorted(total.items()):
        share = sum(counts.values()) / every
        print(f"{cause}: {sum(counts.values())} ({share:.3f})  {dict(counts.most_common(6))}")


if __name__ == "__main__":
    main()
