"""Memory and time of the map of objects over many views of many things, with a false detection in every view.

    python benchmarks/map_memory.py [--views 10000] [--things 500]

A camera goes along a wall with the things in front of it, to the end and back; it sees five of them at a time. In every
view something is detected that is not there. Exit code 1 if memory grows by more than 5 % after the first way back.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
import psutil
from numpy.typing import NDArray

from dataflow.messages.geometry import invert
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.cuboid import ImageView, image_boxes
from operators.scene.map.matching import MapSettings, Observation
from operators.scene.map.object_map import ObjectMap
from operators.scene.map.range_view import RangeView

Array = NDArray[np.float64]
K = np.array([[250.0, 0, 160], [0, 250, 120], [0, 0, 1]])
SIDE, APART, STEP, PERIOD = 0.12, 0.4, 0.2, 100_000_000  # metres; of time, ns
WALL = np.stack(np.meshgrid([4.0], np.linspace(-2, 2, 60), np.linspace(-1, 1.4, 45)), axis=-1).reshape(-1, 3)
FRONT = np.stack(np.meshgrid(np.linspace(-0.45, 0.45, 7), np.linspace(-0.45, 0.45, 7)), axis=-1).reshape(-1, 2)
MOST_GROWTH = 0.05


def front(center: Array) -> Array:
    """Points (49, 3) on the side of a thing that faces the wall's other side."""
    return np.asarray(center + np.column_stack([np.full(len(FRONT), -0.5), FRONT]) * SIDE)


def observed(center: Array, T: Array) -> Observation:
    P = K @ invert(T)[:3]
    box = image_boxes(np.array([[*center, SIDE, SIDE, SIDE, 0.0]]), P, np.array([False]))[0]
    return Observation(front(center), 0, 0.8, None, ImageView(P, box, np.ones(4, np.bool_), T[:3, 3]))


def look(known: ObjectMap, k: int, y: float, things: Array, false: Array) -> None:
    """Takes view k, from a place along the wall, of the things there and of one that is not."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, y, 0.2]
    near = things[np.abs(things[:, 1] - y) < 2.5 * APART]
    wall = WALL + np.array([0, y, 0])
    hidden = np.zeros(len(wall), np.bool_)
    for center in near:
        at = T[:3, 3] + (wall - T[:3, 3]) * (center[0] / wall[:, :1])
        hidden |= (np.abs(at - center)[:, 1:] < SIDE / 2).all(axis=1)
    points = np.concatenate([wall[~hidden], *(front(center) for center in near)])
    seen = [observed(center, T) for center in (*near, false + np.array([0, y, 0]))]
    known.update((k + 1) * PERIOD, seen, RangeView((points - T[:3, 3]) @ T[:3, :3], T, 0.012))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=10_000)
    parser.add_argument("--things", type=int, default=500)
    arguments = parser.parse_args()
    numbers = np.arange(arguments.things)
    things = np.column_stack([np.full(arguments.things, 2.0), APART * numbers, 0.1 + 0.1 * (numbers % 3)])
    end = float(things[-1, 1])
    known, random = ObjectMap(1, ClassPriors([], {}), MapSettings()), np.random.default_rng(1)
    sizes: dict[int, float] = {}
    twice, began = round(2 * end / STEP), time.thread_time()
    print("views  objects  given  MB   ms a view (CPU)")
    for k in range(arguments.views):
        along = STEP * k % (2 * end)
        look(known, k, min(along, 2 * end - along), things, random.uniform([2.6, -0.8, -0.2], [3.4, 0.8, 0.8]))
        if (k + 1) % 1000 == 0:
            sizes[k + 1] = psutil.Process().memory_info().rss / 1e6
            spent, began = time.thread_time() - began, time.thread_time()
            given = len(known.confirmed())
            print(f"{k + 1:6} {len(known.objects):7} {given:6} {sizes[k + 1]:6.1f} {spent:6.1f}", flush=True)
    first = next((size for views, size in sizes.items() if views >= twice), None)
    grown = None if first is None else sizes[max(sizes)] / first - 1
    print("too few views" if grown is None else f"growth after all were seen twice: {grown:.1%}")
    return 1 if grown is None or grown > MOST_GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
