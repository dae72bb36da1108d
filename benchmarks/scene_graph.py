"""Scene graphs of simulated worlds against truth: relations, activities, goals; from sensors and fed with true nodes.

    python benchmarks/scene_graph.py CACHE [--first 600] [--worlds 10] [--every 2]

From sensors: the shipped detector and segmenter, depth, true camera poses, `SemanticMap`, `SceneGraphBuilder`; no other
truth goes in. The map at the end is scored as by semantic_map.py. Relations are scored at every second of the last half
of the drive: of pairs whose two nodes are mapped (3-D IoU 0.25), and over all objects that count. An activity is right
that is true within half a second. A goal counts one second before an agent begins to sit down or to reach.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from semantic_map import IOU, countable, mapped, scored, solids
from sensed_worlds import Frame, World, sensed

from dataflow.messages import Activity, SceneGraph
from operators.scene import SceneGraphBuilder
from operators.scene.box_overlap import upright_iou

PREDICATES = ("on", "in", "sitting_on", "holding", "near", "left_of", "in_front_of")
ARRIVALS = ("sitting_down", "sitting", "reaching")


def matched(nodes: SceneGraph, truth: SceneGraph) -> dict[int, int]:
    """Returns the true id of each of our nodes that is an object of its class by IoU; the floor is the floor."""
    mine, true = (solids(g.positions, g.sizes, g.orientations) for g in (nodes, truth))
    names, labels = ([g.class_names[c] for c in g.class_ids.tolist()] for g in (truth, nodes))
    rows = sorted(
        (
            (upright_iou(true[t], mine[m]), t, m)
            for t in range(truth.count)
            for m in range(nodes.count)
            if names[t] == labels[m] and truth.ids[t] > 0 and np.abs(true[t][0] - mine[m][0]).max() < 2
        ),
        reverse=True,
    )
    of: dict[int, int] = {}
    used: set[int] = set()
    for value, t, m in rows:
        if value >= IOU and int(truth.ids[t]) not in used and int(nodes.ids[m]) not in of:
            of[int(nodes.ids[m])] = int(truth.ids[t])
            used.add(int(truth.ids[t]))
    return of | {0: 0}


def triples(graph: SceneGraph) -> set[tuple[int, str, int]]:
    ids = graph.ids.tolist()
    return {(ids[s], p, ids[o]) for s, p, o in graph.relations() if p in PREDICATES}


def ordered(triple: tuple[int, str, int]) -> tuple[int, str, int]:
    s, p, o = triple
    return (min(s, o), p, max(s, o)) if p == "near" else triple


def compare(graph: SceneGraph, truth: SceneGraph, of: dict[int, int], must: set[int], counts: Counter[str]) -> None:
    """Counts hits, misses and false ones by predicate, of mapped pairs and over all that count."""
    known, ours = set(of.values()), triples(graph)
    true = {ordered(t) for t in triples(truth)}
    mine = {ordered((of[s], p, of[o])) for s, p, o in ours if s in of and o in of}
    for triple in mine | {t for t in true if t[0] in known and t[2] in known}:
        kind = "hit" if triple in mine and triple in true else "false" if triple in mine else "miss"
        counts[f"mapped {kind} {triple[1]}"] += 1
    counts["all hit"] += len(mine & true)
    counts["all false"] += len([t for t in ours if not (t[0] in of and t[2] in of)]) + len(mine - true)
    counts["all miss"] += len([t for t in true - mine if {t[0], t[2]} <= must | {0}])


def f1(counts: Counter[str], scope: str, predicate: str = "") -> float:
    hit, false, miss = (
        sum(n for k, n in counts.items() if k.startswith(f"{scope} {kind}") and k.endswith(predicate))
        for kind in ("hit", "false", "miss")
    )
    return 2 * hit / max(2 * hit + false + miss, 1)


def acts(message: Activity) -> dict[int, str]:
    names = [message.class_names[c] for c in message.class_ids.tolist()]
    return dict(zip(message.subjects.tolist(), names, strict=True))


def compare_acts(world: World, frames: list[Frame], made: list[tuple[Activity, dict[int, int]]]) -> Counter[str]:
    """Counts (true, said) of every agent that is in view and mapped."""
    counts: Counter[str] = Counter()
    for k, (message, of) in enumerate(made):
        said = {of[i]: a for i, a in acts(message).items() if i in of}
        now = acts(frames[k].activities)
        around = [acts(f.activities) for f in frames if abs(f.cloud.stamp - frames[k].cloud.stamp) <= 500_000_000]
        view = set(frames[k].objects.ids[frames[k].objects.visible >= 0.3].tolist())
        for agent, true in now.items():
            if agent in said and agent in view:
                right = any(a.get(agent) == said[agent] for a in around)
                counts[f"{true}|{true if right else said[agent]}"] += 1
    return counts


def macro_f1(counts: Counter[str]) -> float:
    pairs = [(*key.split("|"), n) for key, n in counts.items()]
    scores = []
    for name in {t for t, _, _ in pairs}:
        hit = sum(n for t, s, n in pairs if t == s == name)
        false = sum(n for t, s, n in pairs if s == name != t)
        miss = sum(n for t, s, n in pairs if t == name != s)
        scores.append(2 * hit / max(2 * hit + false + miss, 1))
    return float(np.mean(scores)) if scores else float("nan")


def goals(frames: list[Frame], graphs: list[SceneGraph]) -> dict[str, list[bool]]:
    """Tells for each arrival whether the true goal was first one second before: ours, the nearest, that ahead."""
    found: dict[str, list[bool]] = {"ours": [], "nearest": [], "heading": []}
    last: dict[int, str] = {}
    for k, frame in enumerate(frames):
        said = acts(frame.activities)
        aims = dict(zip(frame.activities.subjects.tolist(), frame.activities.goals, strict=True))
        for agent, activity in said.items():
            before, last[agent] = last.get(agent, activity), activity
            aim = aims[agent].rpartition(" ")[2]
            early = [j for j in range(k) if frame.cloud.stamp - frames[j].cloud.stamp >= 1_000_000_000]
            if before == activity or before not in ("walking", "standing") or activity not in ARRIVALS:
                continue
            if not early or not aim.isdigit():
                continue
            graph, old = graphs[early[-1]], graphs[max(early[-1] - 4, 0)]
            ids, names = graph.ids.tolist(), [graph.class_names[c] for c in graph.class_ids.tolist()]
            candidates = [i for i, n in enumerate(names) if n in ("chair", "table", "mug", "bottle", "door", "shelf")]
            if agent not in ids or int(aim) not in ids:
                continue
            here = graph.positions[ids.index(agent)][:2]
            way = here - old.positions[old.ids.tolist().index(agent)][:2] if agent in old.ids.tolist() else np.zeros(2)
            offsets = {ids[i]: graph.positions[i][:2] - here for i in candidates}
            heads = {
                ids[o]: float(graph.relation_scores[r])
                for r, (s, p, o) in enumerate(graph.relations())
                if p == "heads_for" and ids[s] == agent
            }
            found["ours"].append(max(heads, key=lambda i: heads[i], default=-1) == int(aim))
            found["nearest"].append(min(offsets, key=lambda i: float(np.hypot(*offsets[i]))) == int(aim))
            ahead = {i: float(v @ way) / max(float(np.hypot(*v)), 1e-6) for i, v in offsets.items()}
            found["heading"].append(max(ahead, key=lambda i: ahead[i]) == int(aim))
    return found


def run(world: World, every: int, *, true: bool) -> dict[str, Any]:
    frames = world.frames if true else world.frames[::every]
    builder = SceneGraphBuilder()
    builder.setup()
    figures: dict[str, Any] = {}
    if true:
        nodes = [f.scene for f in frames]
    else:
        objects, nodes = mapped(World(world.name, world.image_info, world.extrinsics, frames), true=False)
        figures = {k: v for k, v in scored(world, objects[-1]).items() if k != "match"}
    must = countable(world)
    counts: Counter[str] = Counter()
    made, graphs = [], []
    for k, (frame, node) in enumerate(zip(frames, nodes, strict=True)):
        out = builder.process(node, frame.base)
        graphs.append(out["graph"])
        late = k >= len(frames) // 2
        of = {i: i for i in node.ids.tolist()} if true else matched(out["graph"], frame.scene)
        made.append((out["activities"], of))
        if late and k % max(1, round(len(frames) / 50)) == 0:
            compare(out["graph"], frame.scene, of, must if not true else set(of), counts)
    return figures | {
        "relations": counts,
        "f1 mapped": f1(counts, "mapped"),
        "f1 all": f1(counts, "all"),
        "acts": compare_acts(world, frames, made),
        "goals": goals(frames, graphs) if true else {},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--every", type=int, default=2, help="take every so many frames of the sensors")
    parser.add_argument("--fed", choices=["true", "sensors", "both"], default="both")
    parser.add_argument("--out", type=Path, help="JSON file for all figures")
    options = parser.parse_args()
    rows: dict[str, list[dict[str, Any]]] = {"true": [], "sensors": []}
    for world in sensed(range(options.first, options.first + options.worlds), options.cache):
        for fed in rows if options.fed == "both" else [options.fed]:
            found = run(world, options.every, true=fed == "true")
            rows[fed].append({"world": world.name} | found)
            told = {k: round(v, 3) for k, v in found.items() if isinstance(v, float)}
            print(world.name, fed, told, "activities", round(macro_f1(found["acts"]), 3), flush=True)
            if options.out is not None:
                options.out.write_text(json.dumps(rows, default=str))
    for fed, found in rows.items():
        if not found:
            continue
        for key in ("recall", "precision", "f1 mapped", "f1 all"):
            values = [r[key] for r in found if key in r]
            if values:
                print(f"{fed} {key}: mean {np.mean(values):.3f}, worst {min(values):.3f}")
        total: Counter[str] = sum((r["relations"] for r in found), Counter())
        print(f"{fed} by predicate:", {p: round(f1(total, "mapped", f" {p}"), 3) for p in PREDICATES})
        said: Counter[str] = sum((r["acts"] for r in found), Counter())
        print(f"{fed} activities: macro-F1 {macro_f1(said):.3f} pooled; majority {majority(said):.3f}; {dict(said)}")
        for name in ("ours", "nearest", "heading"):
            right = [x for r in found for x in r["goals"].get(name, [])]
            if right:
                print(f"{fed} goals, {name}: {np.mean(right):.2f} of {len(right)}")


def majority(counts: Counter[str]) -> float:
    """Returns the macro-F1 of always saying the commonest activity."""
    of_true: Counter[str] = Counter()
    for key, n in counts.items():
        of_true[key.split("|")[0]] += n
    if not of_true:
        return float("nan")
    name = of_true.most_common(1)[0][0]
    return macro_f1(Counter({f"{t}|{name}": n for t, n in of_true.items()}))


if __name__ == "__main__":
    main()
