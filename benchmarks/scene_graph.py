"""Scene graphs of simulated worlds against truth: relations, activities, goals; from sensors and fed with true nodes.

    python benchmarks/scene_graph.py CACHE [--first 600] [--worlds 10] [--every 1] [--rough]

From sensors: the shipped detector and segmenter, depth, true camera poses, `SemanticMap`, `SceneGraphBuilder`; no other
truth goes in. The map at the end is scored as by semantic_map.py. Relations are scored at every second of the last half
of the drive: of pairs whose two nodes are mapped (3-D IoU 0.25), and over all objects that count by then, as
SceneGraphMetrics counts them: plainly seen so far, movers while they are in view. *Whole drive* also counts those that
will be plainly seen later, and movers that are out of view. An activity is right that is true within half a second. A
goal counts one second before an agent begins to sit down or to reach.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from semantic_map import mapped, plainly_seen, scored, seen
from sensed_worlds import Frame, World, ids_in_view, sensed

from dataflow.messages import Activity, SceneGraph
from operators.recognition.activity import samples
from operators.recognition.activity.tracked_people import simulated_labels
from operators.scene import SceneGraphBuilder
from operators.scene.scoring import PREDICATES, RelationScore, score_nodes

SCOPES = ("mapped", "all")
ARRIVALS = ("sitting_down", "sitting", "reaching")


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
        view = ids_in_view(frames[k].objects, 0.3)
        for agent, true in now.items():
            if agent in said and agent in view:
                right = any(a.get(agent) == said[agent] for a in around)
                counts[f"{true}|{true if right else said[agent]}"] += 1
    return counts


def macro_f1(counts: Counter[str]) -> float:
    """Returns the macro-F1 of counts by `true|said`; NaN where there are none."""
    pairs = [key.split("|") for key in counts.elements()]
    return samples.macro_f1([t for t, _ in pairs], [s for _, s in pairs]) if pairs else float("nan")


def goals(frames: list[Frame], graphs: list[SceneGraph]) -> dict[str, list[bool]]:
    """Returns for each arrival whether the true goal was first one second before: ours, the nearest, that ahead."""
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
            now = frames[early[-1]].cloud.stamp
            before_that = [j for j in early if now - frames[j].cloud.stamp >= 1_000_000_000]
            graph, old = graphs[early[-1]], graphs[before_that[-1] if before_that else 0]
            ids, names = graph.ids.tolist(), [graph.class_names[c] for c in graph.class_ids.tolist()]
            candidates = [i for i, n in enumerate(names) if n in ("chair", "table", "mug", "bottle", "door", "shelf")]
            if agent not in ids or int(aim) not in ids:
                continue
            here = graph.positions[ids.index(agent)][:2]
            way = here - old.positions[old.ids.tolist().index(agent)][:2] if agent in old.ids.tolist() else np.zeros(2)
            offsets = {ids[i]: graph.positions[i][:2] - here for i in candidates}
            assert graph.relation_scores is not None
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
    builder = SceneGraphBuilder(labels="simulator")
    builder.setup()
    figures: dict[str, Any] = {}
    if true:
        nodes = [f.scene for f in frames]
    else:
        nodes = mapped(World(world.name, world.image_info, world.extrinsics, frames), true=False)
        last = scored(world, nodes[-1])
        figures = {"recall": last.recall, "precision": last.precision, "doubles": len(last.doubles)}
    whole, counts = seen(world).countable(), plainly_seen()
    relations, of_drive = RelationScore(), RelationScore()
    made, graphs = [], []
    for k, (frame, node) in enumerate(zip(frames, nodes, strict=True)):
        out = builder.process(node, frame.base)
        graphs.append(out["graph"])
        late = k >= len(frames) // 2
        counts.add(frame.objects)
        must = counts.must(frame.scene, simulated_labels())
        score = score_nodes(out["graph"], frame.scene, must)
        of = {i: i for i in node.ids.tolist()} if true else score.match
        made.append((out["activities"], of))
        if late and k % max(1, round(len(frames) / 50)) == 0:
            relations.add(out["graph"], frame.scene, of, set(of) if true else must, () if true else score.ignored)
            ignored = score_nodes(out["graph"], frame.scene, whole).ignored
            of_drive.add(out["graph"], frame.scene, of, set(of) if true else whole, () if true else ignored)
    return figures | {
        "relations": relations.counts,
        **{f"f1 {scope}": relations.f1(scope) for scope in SCOPES},
        **{f"edge precision {scope}": relations.precision(scope) for scope in SCOPES},
        **{f"edge recall {scope}": relations.recall(scope) for scope in SCOPES},
        "f1 whole drive": of_drive.f1("all"),
        "acts": compare_acts(world, frames, made),
        "goals": goals(frames, graphs) if true else {},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--every", type=int, default=1, help="take every so many frames of the sensors")
    parser.add_argument("--fed", choices=["true", "sensors", "both"], default="both")
    parser.add_argument("--rough", action="store_true", help="a real camera's noise, and calibrations that are off")
    parser.add_argument("--out", type=Path, help="JSON file for all figures")
    options = parser.parse_args()
    rows: dict[str, list[dict[str, Any]]] = {"true": [], "sensors": []}
    for world in sensed(range(options.first, options.first + options.worlds), options.cache, rough=options.rough):
        for fed in rows if options.fed == "both" else [options.fed]:
            found = run(world, options.every, true=fed == "true")
            rows[fed].append({"world": world.name} | found)
            told = {k: round(v, 3) for k, v in found.items() if isinstance(v, float)}
            print(world.name, fed, told, "activities", round(macro_f1(found["acts"]), 3), flush=True)
            if options.out is not None:
                options.out.write_text(json.dumps(rows, default=str))
    for fed, worlds in rows.items():
        if not worlds:
            continue
        edges = [f"{what} {scope}" for what in ("f1", "edge precision", "edge recall") for scope in SCOPES]
        for key in ("recall", "precision", *edges, "f1 whole drive"):
            values = [r[key] for r in worlds if key in r]
            if values:
                print(f"{fed} {key}: mean {np.mean(values):.3f}, worst {min(values):.3f}")
        total = RelationScore()
        for row in worlds:
            total.counts.update(row["relations"])
        print(f"{fed} by predicate:", {p: round(total.f1("mapped", f" {p}"), 3) for p in PREDICATES})
        said: Counter[str] = sum((r["acts"] for r in worlds), Counter())
        print(f"{fed} activities: macro-F1 {macro_f1(said):.3f} pooled; majority {majority(said):.3f}; {dict(said)}")
        for name in ("ours", "nearest", "heading"):
            right = [x for r in worlds for x in r["goals"].get(name, [])]
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
