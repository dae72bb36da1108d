"""3-D tracking of the movers of simulated worlds, from noisy boxes with misses: identities, places, velocities.

    python benchmarks/tracking_3d.py [--seeds 10]

Boxes are the true ones with noise of 8 cm on the centre, 10 % on the extent, the heading up to half a turn; 10 % are
missed, and each object for spells of 0.3 to 1 s; 0.2 false boxes a frame.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import SceneGraph, TrackState
from dataflow.messages.geometry import yaw_of
from operators.simulator.robot import SimulatedRobot
from operators.tracking.box_tracker_3d import BoxTracker3D, BoxTracker3DSettings, Solids

RATE, SECONDS, FIRST = 10.0, 20, 700
WORLDS = ("office", "corridor", "table_top")
MOVERS = ("person", "robot", "ball")


def scenes(world: str, seed: int) -> list[SceneGraph]:
    robot = SimulatedRobot(
        world=world,
        seed=seed,
        people=3,
        duration=f"{SECONDS}s",
        color_camera={"rate": 0},
        depth_camera={"rate": 0},
        truth={"relations": RATE, "poses": 0, "activities": 0, "spatial": False},
    )
    robot.setup()
    found = [m["scene"] for m in robot.stream() if "scene" in m]
    robot.close()
    return [g for g in found if isinstance(g, SceneGraph)]


def measured(
    graph: SceneGraph, rows_of: list[int], blind: dict[int, int], rng: np.random.Generator
) -> tuple[Solids, NDArray[np.float64]]:
    """Boxes of these rows of a scene as a detector gives them, with gaps and false ones, and their errors (N,)."""
    kept = []
    for j, i in zip(rows_of, graph.ids[rows_of].tolist(), strict=True):
        blind[i] = blind.get(i, 0) - 1
        if blind[i] < -3 and rng.random() < 0.02:
            blind[i] = int(rng.integers(3, 10))
        if blind[i] <= 0 and rng.random() < 0.9:
            kept.append(j)
    count = int(rng.poisson(0.2))
    assert graph.orientations is not None
    assert graph.sizes is not None
    centers = graph.positions[kept] + rng.normal(0, 0.08, (len(kept), 3))
    spots = rng.uniform([-4, -4, 0.3], [4, 4, 1.2], (count, 3))
    yaws = yaw_of(graph.orientations[kept]) + np.pi * rng.integers(0, 2, len(kept)) if kept else np.zeros(0)
    found = Solids(
        np.concatenate([centers, spots]),
        np.concatenate([graph.sizes[kept] * rng.normal(1, 0.1, (len(kept), 3)), np.full((count, 3), 0.5)]),
        np.concatenate([yaws, np.zeros(count)]),
        np.concatenate([rng.uniform(0.6, 0.95, len(kept)), rng.uniform(0.2, 0.6, count)]),
        np.concatenate([graph.class_ids[kept], rng.choice(graph.class_ids[rows_of], count)]).astype(np.int32),
    )
    return found, np.linalg.norm(centers - graph.positions[kept], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    options = parser.parse_args()
    rows = []
    for k in range(options.seeds):
        rng = np.random.default_rng(k)
        tracker = BoxTracker3D(BoxTracker3DSettings())
        said: dict[int, int] = {}
        blind: dict[int, int] = {}
        switches = seen = held = false = 0
        places, speeds, raw = list[float](), list[float](), list[float]()
        before: SceneGraph | None = None
        graphs = scenes(WORLDS[k % 3], FIRST + k)
        travelled = np.ptp([g.positions for g in graphs], axis=0).max(axis=1)
        for graph in graphs:
            names = [graph.class_names[c] for c in graph.class_ids.tolist()]
            rows_of = [j for j, n in enumerate(names) if n in MOVERS and travelled[j] > 0.2]
            ids = graph.ids[rows_of].tolist()
            found, off = measured(graph, rows_of, blind, rng)
            raw.extend(off)
            tracks = [
                t
                for t in tracker.update(graph.stamp, found)
                if t.state in (TrackState.CONFIRMED, TrackState.COASTING) and t.score >= 0.5
            ]
            used = set()
            for j, i in zip(rows_of, ids, strict=True):
                near = [t for t in tracks if t.id not in used and t.class_id == graph.class_ids[j]]
                best = min(near, key=lambda t: float(np.linalg.norm(t.mean[:3] - graph.positions[j])), default=None)
                seen += 1
                if best is None or np.linalg.norm(best.mean[:3] - graph.positions[j]) > 0.5:
                    continue
                used.add(best.id)
                held += 1
                switches += said.get(i, best.id) != best.id
                said[i] = best.id
                places.append(float(np.linalg.norm(best.mean[:3] - graph.positions[j])))
                if before is not None and graph.stamp - before.stamp > 0:
                    true = (graph.positions[j] - before.positions[j]) / ((graph.stamp - before.stamp) * 1e-9)
                    speeds.append(float(np.linalg.norm(best.mean[3:] - true)))
            false += len(tracks) - len(used)
            before = graph
        rows.append([held / seen, false / seen, switches, np.median(raw), np.median(places), np.median(speeds)])
        print(WORLDS[k % 3], FIRST + k, [round(float(v), 3) for v in rows[-1]], flush=True)
    table = np.array(rows)
    print("| | found | false | id switches | centre of a box | of a track | velocity |\n" + "| --- " * 7 + "|")
    for name, values in (("mean", table.mean(axis=0)), ("worst", [table[:, 0].min(), *table[:, 1:].max(axis=0)])):
        found, wrong, switches, box, place, speed = values
        print(
            f"| {name} | {found:.3f} | {wrong:.3f} | {switches:.1f} | {box:.3f} m | {place:.3f} m | {speed:.3f} m/s |"
        )


if __name__ == "__main__":
    main()
