"""Gaps in drives through simulated worlds: whether RGB-D odometry finds its map again, and whether it is that place."""

from __future__ import annotations

import copy
from dataclasses import dataclass
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
BEGINS = tuple(range(40, 300, 20))  # first frames that are missing
LENGTHS = (10, 20, 40, 80)  # how many, at 10 Hz
AFTER = 10  # frames that follow: 1 s
SEEN, SAME = 0.5, 0.1  # share of a view, metres
WRONG = (0.2, 0.1)  # metres, radians
EARLIER = 5  # frames from one earlier view to the next that is compared


@dataclass(frozen=True)
class Gap:
    """Holds which of the frames after a gap claim to be in the old map, and are right or wrong, and whether the first
    shows what was seen before."""

    seen: bool
    right: tuple[bool, ...]
    wrong: tuple[bool, ...]


def table(worlds: list[str], cache: Path) -> None:
    """Prints what came of every gap, summed over each world."""
    print("| world | gaps | found | lost | wrong | seen before | of these found at once | within 1 s |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    totals = np.zeros(7, np.int64)
    for world in worlds:
        counts = np.array(summed(gaps(rendered(cache, world))), np.int64)
        totals += counts
        _show(world.replace(":", " "), counts)
    _show("all", totals)


def summed(every: list[Gap]) -> list[int]:
    """Returns how many gaps there are, end in the right place within a second, in no place, and in a wrong one; how
    many end in sight of what was seen before, and of these are found from the first frame on, and within a second."""
    wrong = [any(gap.wrong) for gap in every]
    found = [any(gap.right) and not off for gap, off in zip(every, wrong, strict=True)]
    seen = [gap for gap in every if gap.seen]
    return [
        len(every), sum(found), len(every) - sum(found) - sum(wrong), sum(wrong),
        len(seen), sum(gap.right[0] for gap in seen), sum(any(gap.right) for gap in seen),
    ]  # fmt: skip


def gaps(drive: Drive) -> list[Gap]:
    """Returns what came of every gap in a drive."""
    found, odometry = [], RgbdOdometry(drive.camera)
    for i in range(max(BEGINS) + 1):
        if i in BEGINS:
            found += [_gap(drive, odometry, i, length) for length in LENGTHS]
        odometry.track(drive.image[i], drive.depth[i], int(drive.stamps[i]))
    return found


def _gap(drive: Drive, before: RgbdOdometry, begins: int, length: int) -> Gap:
    odometry = RgbdOdometry(drive.camera, state=copy.deepcopy(before.state))
    last = before.state.motion
    assert last is not None
    T_world_truth = last.T_world_camera @ invert(drive.truth[begins - 1])
    segment = odometry.state.map.newest.segment
    right, wrong = [], []
    for i in range(begins + length, begins + length + AFTER):
        result = odometry.track(drive.image[i], drive.depth[i], int(drive.stamps[i]))
        claimed = odometry.state.map.newest.segment == segment and result.status in MEASURED
        x = se3.log(invert(T_world_truth @ drive.truth[i]) @ result.T_world_camera)
        off = bool(np.linalg.norm(x[:3]) > WRONG[0] or np.linalg.norm(x[3:]) > WRONG[1])
        right.append(claimed and not off)
        wrong.append(claimed and off)
    return Gap(shared(drive, begins + length, begins) >= SEEN, tuple(right), tuple(wrong))


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
    print(f"| {name} | {' | '.join(str(count) for count in counts.tolist())} |", flush=True)
