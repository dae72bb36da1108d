"""Gaps in drives through simulated worlds: whether RGB-D odometry finds its map again, and whether it is that place."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from odometry_worlds import Drive, rendered

from dataflow.messages.geometry import invert, transform_points
from operators.geometry import se3
from operators.geometry.pinhole import project
from operators.odometry.rgbd.surface import Surface
from operators.odometry.rgbd.tracker import RgbdOdometry
from operators.odometry.tracking import MEASURED

Array = NDArray[np.float64]

WORLDS = ("office:823", "office:824", "corridor:823", "corridor:824", "table_top:823", "table_top:824")
BEGINS = (60, 120, 180, 240)  # first frames that are missing
LENGTHS = (20, 80)  # how many, at 10 Hz
AFTER = 10  # frames that follow: 1 s
SEEN, SAME = 0.5, 0.1  # share of a view, metres
WRONG = (0.2, 0.1)  # metres, radians
EARLIER = 5  # frames from one earlier view to the next that is compared


def table(worlds: list[str], cache: Path) -> None:
    """Prints what came of every gap, summed over each world."""
    print("| world | gaps | frames seen before | tracked of them % | found at once | within 1 s | wrong |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    totals = np.zeros(6, np.int64)
    for world in worlds:
        counts = np.array(list(counted(rendered(cache, world)).values()), np.int64)
        totals += counts
        _show(world.replace(":", " "), counts)
    _show("all", totals)


def counted(drive: Drive) -> dict[str, int]:
    """Returns how many gaps end in sight of what was seen before, in how many frames it is, in how many of these the
    camera is tracked, after how many gaps from the first on, after how many within a second, and false frames."""
    totals = {"gaps": 0, "seen": 0, "tracked": 0, "at once": 0, "within": 0, "wrong": 0}
    odometry = RgbdOdometry(drive.camera)
    for i in range(max(BEGINS) + 1):
        if i in BEGINS:
            for length in LENGTHS:
                for name, count in _gap(drive, odometry, i, length).items():
                    totals[name] += count
        odometry.track(drive.image[i], drive.depth[i], int(drive.stamps[i]))
    return totals


def _gap(drive: Drive, before: RgbdOdometry, begins: int, length: int) -> dict[str, int]:
    odometry = RgbdOdometry(drive.camera)
    odometry.restore(before.snapshot())
    last = before.snapshot().motion
    assert last is not None
    T_world_truth = last.T_world_camera @ invert(drive.truth[begins - 1])
    segment = odometry.snapshot().keyframes[-1].segment
    seen, right, wrong = [], [], 0
    for i in range(begins + length, min(begins + length + AFTER, len(drive.stamps))):
        result = odometry.track(drive.image[i], drive.depth[i], int(drive.stamps[i]))
        joined = odometry.snapshot().keyframes[-1].segment == segment
        claimed = joined and result.status in MEASURED
        x = se3.log(invert(T_world_truth @ drive.truth[i]) @ result.T_world_camera)
        off = bool(np.linalg.norm(x[:3]) > WRONG[0] or np.linalg.norm(x[3:]) > WRONG[1])
        wrong += claimed and off
        seen.append(shared(drive, i, begins) >= SEEN)
        right.append(claimed and not off)
    there = np.flatnonzero(seen)
    found = [i for i in there if right[i]]
    return {
        "gaps": int(len(there) > 0),
        "seen": len(there),
        "tracked": len(found),
        "at once": int(len(there) > 0 and right[there[0]]),
        "within": int(len(found) > 0),
        "wrong": wrong,
    }


def shared(drive: Drive, i: int, begins: int) -> float:
    """Returns the share of what a frame sees that the best of some views before the gap saw, by the true poses."""
    here = _surface(drive, i).points(4)
    shares = [0.0]
    for j in range(0, begins, EARLIER):
        there = _surface(drive, j)
        moved = transform_points(invert(drive.truth[j]) @ drive.truth[i], here)
        moved = moved[moved[:, 2] > 0.1]
        if not len(moved):
            continue
        u, v = np.rint(project(moved, there.K)).astype(np.int64).T
        h, w = there.inverse_depth.shape
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h)
        inverse = there.inverse_depth[v[inside], u[inside]]
        off = np.abs(1.0 / np.maximum(inverse, 1e-6) - moved[inside, 2])
        shares.append(float(np.count_nonzero((inverse > 0) & (off < SAME)) / max(len(here), 1)))
    return max(shares)


@lru_cache(maxsize=100)
def _surface(drive: Drive, i: int) -> Surface:
    return Surface.from_depth(drive.depth[i], drive.camera.K_depth, 0.3, 6.0, 2)


def _show(name: str, counts: NDArray[np.int64]) -> None:
    gaps, seen, tracked, at_once, within, wrong = counts.tolist()
    share = 100 * tracked / max(seen, 1)
    print(f"| {name} | {gaps} | {seen} | {share:.1f} | {at_once} | {within} | {wrong} |", flush=True)
