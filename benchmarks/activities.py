"""Activities and goals of people in simulated worlds: ours, rules and baselines, on true boxes and from sensors.

    python benchmarks/activities.py true FOLDER [--first 600] [--worlds 10]
    python benchmarks/activities.py sensors CACHE [--first 600] [--worlds 10] [--every 1]
    python benchmarks/activities.py arrivals CACHE [--first 600] [--worlds 10]
    python benchmarks/activities.py sensors CACHE --route watch [--first 600] [--worlds 10]

*true*: the simulator's boxes, 4 times a second for 45 s; FOLDER keeps them, nothing is rendered. *sensors*: the shipped
detector and segmenter, depth and true camera poses give a map; CACHE keeps what the networks gave (sensed_worlds.py).
An agent counts while it is in view, and from sensors where it is mapped (IoU 0.25). An activity is right that is true
within half a second; `unknown` is wrong. A goal counts one second before an agent begins to sit down or to reach.
Beside the scores: what is true against what is said, and which part of the agents in view was lost where.
Goals of two counts of arrivals: of those whose agent and goal are mapped then, and of all that the camera could show:
the agent is in view at that time, the goal at or before it; what is not mapped is missed.
*arrivals*: how many the camera could show. *watch*: the robot stands with the people who choose in view, no tour.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from scene_graph import acts, macro_f1, majority
from sensed_worlds import KINDS, Mapped, World, ids_in_view, mapped, sensed

from dataflow.messages import Activity, Boxes3D, Classification, Odometry, Pose, SceneGraph
from dataflow.messages.geometry import quaternion_from_yaw
from operators.recognition import ActivityRecognizer
from operators.recognition.activity.episodes import Episode
from operators.recognition.activity.sensed_people import nearest_agents
from operators.scene import SceneGraphBuilder
from operators.scene.scoring import match_nodes
from operators.training.simulated_people import read_episodes, write_episodes

SECOND = 1_000_000_000
ARRIVALS, UNDER_WAY = ("sitting_down", "sitting", "reaching"), ("standing", "walking")
METHODS = ("ours", "nearest", "heading")
CANDIDATES = ("chair", "table", "mug", "bottle", "door", "shelf")


@dataclass(frozen=True)
class Step:
    """One time: the nodes given, the robot, and the truth: what agents in view do, all activities and goals by id."""

    nodes: SceneGraph
    robot: Pose | Odometry
    view: set[int]
    doing: dict[int, str]
    goals: dict[int, int]
    match: Callable[[SceneGraph], dict[int, int]]
    near: Callable[[SceneGraph], set[int]]
    """True agents of which a node of their class is within a metre."""
    objects: Boxes3D | None = None
    postures: Classification | None = None


@dataclass
class Figures:
    """Counts (true|said) by method, and for each arrival the first goal by method, and the lead in seconds.

    `seen` are counts of all agents in view: true|said with `not mapped`; `lost` has their outcomes.
    """

    acts: dict[str, Counter[str]] = field(default_factory=dict)
    goals: dict[str, list[bool]] = field(default_factory=lambda: {name: [] for name in METHODS})
    shown: dict[str, list[bool]] = field(default_factory=lambda: {name: [] for name in METHODS})
    """Of all arrivals that the camera could show."""
    candidates: list[int] = field(default_factory=list)
    leads: list[float] = field(default_factory=list)
    seen: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)


def true_steps(episode: Episode, stride: int = 2) -> Iterator[Step]:
    names = tuple(dict.fromkeys(episode.labels))
    ids = episode.ids.tolist()
    for row in range(0, len(episode.times), stride):
        boxes = episode.boxes[row].astype(np.float64)
        nodes = SceneGraph(
            stamp=round(episode.times[row] * 1e9),
            frame="world",
            class_names=names,
            ids=episode.ids,
            class_ids=np.array([names.index(label) for label in episode.labels], np.int32),
            positions=boxes[:, :3],
            sizes=boxes[:, 3:6],
            orientations=quaternion_from_yaw(boxes[:, 6]),
            subjects=np.zeros(0, np.int32),
            objects=np.zeros(0, np.int32),
        )
        place = np.eye(4)
        place[:2, 3] = episode.camera[row, :2, 3]
        ahead = episode.camera[row, :2, 2] / np.linalg.norm(episode.camera[row, :2, 2])
        place[:2, :2] = [[ahead[0], -ahead[1]], [ahead[1], ahead[0]]]
        robot = Pose.from_matrix(place, stamp=nodes.stamp, frame="world", child_frame="base_link")
        agents = episode.agents.tolist()
        doing = dict(zip(agents, episode.activities[row], strict=True))
        goals = dict(zip(agents, episode.goals[row].tolist(), strict=True))
        yield Step(
            nodes, robot, set(agents), doing, goals, lambda _: {i: i for i in ids}, lambda g: set(g.ids.tolist())
        )


def sensor_steps(world: World) -> Iterator[Step]:
    yield from steps_of(world, mapped(world))


def steps_of(world: World, made: Sequence[Mapped | None]) -> Iterator[Step]:
    """Yields the times of a world with what was mapped, or with the true nodes where nothing was."""
    for frame, given in zip(world.frames, made, strict=True):
        view = ids_in_view(frame.objects, 0.3)
        said = zip(frame.activities.subjects.tolist(), frame.activities.goals, strict=True)
        goals = {i: int(g.rpartition(" ")[2]) if g.rpartition(" ")[2].isdigit() else -1 for i, g in said}
        truth = frame.scene
        match = partial(match_nodes, truth=truth)
        near = partial(agents_near, truth=truth)
        doing = acts(frame.activities)
        if given is None:
            yield Step(truth, frame.base, view, doing, goals, match, near)
        else:
            yield Step(given.nodes, frame.base, view, doing, goals, match, near, given.objects, given.postures)


def agents_near(graph: SceneGraph, truth: SceneGraph) -> set[int]:
    """The agents that have a node of their class near them."""
    return set(nearest_agents(graph, truth).values())


def figures_of(steps: list[Step]) -> Figures:
    """Runs recogniser and builder over the steps, and the builder alone, whose rules are the baseline."""
    recognizer = ActivityRecognizer(labels="simulator")
    ours, rules = SceneGraphBuilder(labels="simulator"), SceneGraphBuilder(labels="simulator")
    for each in (recognizer, ours, rules):
        each.setup()
    said: dict[str, list[dict[int, str]]] = {"ours": [], "rules": [], "network": []}
    graphs, ofs = [], []
    for step in steps:
        recognized = recognizer.process(step.nodes, step.robot, step.objects, step.postures)
        built = ours.process(step.nodes, step.robot, recognized=recognized)
        of = step.match(built["graph"])
        graphs.append(built["graph"])
        ofs.append(of)
        alone: Activity = rules.process(step.nodes, step.robot)["activities"]
        for name, message in (("ours", built["activities"]), ("rules", alone), ("network", recognized)):
            said[name].append({of[i]: a for i, a in acts(message).items() if i in of})
    found = Figures({name: compared(steps, given) for name, given in said.items()})
    losses(steps, said["ours"], said["network"], found)
    arrivals(steps, graphs, ofs, found)
    return found


def compared(steps: list[Step], said: list[dict[int, str]]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for step, given in zip(steps, said, strict=True):
        around = [s.doing for s in steps if abs(s.nodes.stamp - step.nodes.stamp) <= SECOND // 2]
        for agent, true in step.doing.items():
            if agent in given and agent in step.view:
                right = any(doing.get(agent) == given[agent] for doing in around)
                counts[f"{true}|{true if right else given[agent]}"] += 1
    return counts


def losses(steps: list[Step], ours: list[dict[int, str]], network: list[dict[int, str]], found: Figures) -> None:
    """Counts what was said of every agent in view, and where those were lost of which it is wrong."""
    for step, given, raw in zip(steps, ours, network, strict=True):
        around = [s.doing for s in steps if abs(s.nodes.stamp - step.nodes.stamp) <= SECOND // 2]
        near = step.near(step.nodes)
        for agent in step.view & set(step.doing):
            true, said = step.doing[agent], given.get(agent, "not mapped")
            right = any(doing.get(agent) == said for doing in around)
            found.seen[f"{true}|{true if right else said}"] += 1
            if agent not in given:
                found.lost["node of another place" if agent in near else "no node within 1 m"] += 1
            else:
                by = "rules, as the network does not know" if raw.get(agent) == "unknown" else "network"
                found.lost[f"{'right' if right else 'wrong'} by {by}"] += 1


def arriving(steps: list[Step]) -> Iterator[tuple[int, int, int, int]]:
    """Yields the agent and the goal of every arrival, with the steps at it and one second before it."""
    for k in range(1, len(steps)):
        for agent, doing in steps[k].doing.items():
            goal = steps[k].goals.get(agent, -1)
            early = [j for j in range(k) if steps[k].nodes.stamp - steps[j].nodes.stamp >= SECOND]
            if doing in ARRIVALS and steps[k - 1].doing.get(agent) in UNDER_WAY and goal >= 0 and early:
                yield agent, goal, k, early[-1]


def shown(steps: list[Step]) -> Counter[str]:
    """Counts what the camera showed of all arrivals, one second before each."""
    counts: Counter[str] = Counter()
    for agent, goal, _, j in arriving(steps):
        counts["arrivals"] += 1
        counts["agent in view"] += agent in steps[j].view
        counts["goal seen too"] += agent in steps[j].view and any(goal in step.view for step in steps[: j + 1])
        since = [s for s in steps[:j] if steps[j].nodes.stamp - s.nodes.stamp <= SECOND]
        counts["for a second before"] += all(agent in step.view for step in (*since, steps[j]))
    return counts


def arrivals(steps: list[Step], graphs: list[SceneGraph], ofs: list[dict[int, int]], found: Figures) -> None:
    """Scores the goals of every arrival whose agent is in view a second before."""
    for agent, goal, k, j in arriving(steps):
        if agent not in steps[j].view:
            continue
        mine = {t: m for m, t in ofs[j].items()}
        could = any(goal in step.view for step in steps[: j + 1])
        if agent not in mine or goal not in mine:
            for missed in found.shown.values() if could else ():
                missed.append(False)
            continue
        graph, me, aim = graphs[j], mine[agent], mine[goal]
        ids, names = graph.ids.tolist(), [graph.class_names[c] for c in graph.class_ids.tolist()]
        here = graph.positions[ids.index(me)][:2]
        offsets = {i: graph.positions[n][:2] - here for n, i in enumerate(ids) if names[n] in CANDIDATES}
        near = {i: o for i, o in offsets.items() if np.hypot(*o) < 5}
        found.candidates.append(len(near))
        right = {
            "ours": first(graph, me) == aim,
            "nearest": min(near, key=lambda i: float(np.hypot(*near[i])), default=-1) == aim,
        }
        old = graphs[max(j - 4, 0)]
        way = here - old.positions[old.ids.tolist().index(me)][:2] if me in old.ids.tolist() else np.zeros(2)
        ahead = {i: float(o @ way) / max(float(np.hypot(*o)), 1e-6) for i, o in near.items()}
        right["heading"] = max(ahead, key=lambda i: ahead[i], default=-1) == aim
        for name, value in right.items():
            found.goals[name].append(value)
            if could:
                found.shown[name].append(value)
        since = k
        while since > 0 and first(graphs[since - 1], me) == aim:
            since -= 1
        found.leads.append((steps[k].nodes.stamp - steps[since].nodes.stamp) / SECOND)


def first(graph: SceneGraph, agent: int) -> int:
    """Returns the likeliest goal of an agent, -1 for none."""
    ids = graph.ids.tolist()
    scores = [] if graph.relation_scores is None else graph.relation_scores.tolist()
    heads = {ids[o]: scores[r] for r, (s, p, o) in enumerate(graph.relations()) if p == "heads_for" and ids[s] == agent}
    return max(heads, key=lambda i: heads[i], default=-1)


def report(rows: dict[str, Figures]) -> None:
    for name in ("ours", "rules", "network"):
        values = [macro_f1(found.acts[name]) for found in rows.values()]
        total: Counter[str] = sum((found.acts[name] for found in rows.values()), Counter())
        print(f"activities, {name}: mean {np.mean(values):.3f}, worst {min(values):.3f}, pooled {macro_f1(total):.3f}")
        if name == "ours":
            print(f"activities, majority class: mean {np.mean([majority(f.acts[name]) for f in rows.values()]):.3f}")
            print("   by class:", by_class(total), "\n   wrong:", {k: n for k, n in total.most_common() if differ(k)})
    print("agents in view:", dict(sum((found.lost for found in rows.values()), Counter()).most_common()))
    table(sum((found.seen for found in rows.values()), Counter()))
    for of in ("goals", "shown"):
        for name in METHODS:
            worlds = [vars(found)[of][name] for found in rows.values() if vars(found)[of][name]]
            if worlds:
                right = [x for world in worlds for x in world]
                each = [float(np.mean(world)) for world in worlds]
                print(
                    f"{of}, {name}: {np.mean(right):.3f} of {len(right)} arrivals in {len(worlds)} worlds, "
                    f"mean over the worlds {np.mean(each):.3f}, worst {min(each):.2f}"
                )
    leads = [x for found in rows.values() for x in found.leads]
    if leads:
        many = [x for found in rows.values() for x in found.candidates]
        print(f"goals: median lead {np.median(leads):.2f} s, candidates {min(many)} to {max(many)}")


def table(counts: Counter[str]) -> None:
    """Prints what is true, a row each, against what is said."""
    pairs = {tuple(key.split("|")): n for key, n in counts.items()}
    columns = sorted({said for _, said in pairs})
    print(f"{'true, said:':>13}", *(f"{name:>12}" for name in columns))
    for true in sorted({true for true, _ in pairs}):
        print(f"{true:>13}", *(f"{pairs.get((true, said), 0):12d}" for said in columns))


def differ(pair: str) -> bool:
    true, said = pair.split("|")
    return true != said


def by_class(counts: Counter[str]) -> dict[str, float]:
    names = sorted({key.split("|")[0] for key in counts})
    found = {}
    for name in names:
        hit = counts[f"{name}|{name}"]
        others = sum(n for key, n in counts.items() if differ(key) and name in key.split("|"))
        found[name] = round(2 * hit / (2 * hit + others), 3)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fed", choices=["true", "sensors", "arrivals"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=600)
    parser.add_argument("--worlds", type=int, default=10)
    parser.add_argument("--every", type=int, default=1, help="take every so many frames of the sensors")
    parser.add_argument("--route", choices=["tour", "watch"], default="tour", help="of the robot with sensors")
    parser.add_argument("--seeds", type=int, nargs="*", help="in place of --first and --worlds")
    parser.add_argument("--out", type=Path, help="JSON file for all counts")
    options = parser.parse_args()
    seeds = options.seeds or list(range(options.first, options.first + options.worlds))
    if options.fed == "arrivals":
        report_shown(sensed(seeds, options.folder, options.route))
        return
    rows: dict[str, Figures] = {}
    true = options.fed == "true"
    for name, steps in (
        true_worlds(seeds, options.folder)
        if true
        else sensed_steps(sensed(seeds, options.folder, options.route), options.every)
    ):
        rows[name] = figures_of(steps)
        told = {n: round(macro_f1(c), 3) for n, c in rows[name].acts.items()}
        goals = {of: {n: f"{sum(x)}/{len(x)}" for n, x in vars(rows[name])[of].items()} for of in ("goals", "shown")}
        print(name, told, goals, flush=True)
        if options.out is not None:
            options.out.write_text(json.dumps({n: vars(f) for n, f in rows.items()}))
    report(rows)


def report_shown(worlds: Iterable[World]) -> None:
    total: Counter[str] = Counter()
    for world in worlds:
        counts = shown(list(steps_of(world, [None] * len(world.frames))))
        print(world.name, dict(counts), flush=True)
        total.update(counts)
    print("all", dict(total))


def true_worlds(seeds: Sequence[int], folder: Path) -> Iterator[tuple[str, list[Step]]]:
    chosen = [(KINDS[seed % len(KINDS)], seed, 3) for seed in seeds]
    for _made in write_episodes(folder, chosen, 1):
        pass
    for episode in read_episodes(folder, chosen):
        yield episode.name, list(true_steps(episode))


def sensed_steps(worlds: Iterable[World], every: int) -> Iterator[tuple[str, list[Step]]]:
    for world in worlds:
        thinned = World(world.name, world.image_info, world.extrinsics, world.frames[::every])
        yield world.name, list(sensor_steps(thinned))


if __name__ == "__main__":
    main()
