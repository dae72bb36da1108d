"""Landmark SLAM without identities, on made rounds with known truth: how often it is right, and what it reports if not.

    OMP_NUM_THREADS=1 python benchmarks/landmark_association.py --seeds 20
    OMP_NUM_THREADS=1 python benchmarks/landmark_association.py --seeds 6 --noise 2      # odometry noisier than told

A robot drives two rounds of a square of 20 m among 40 landmarks, with a sensor of 8 m and 4 rad. A seed is right where
the pose is within 0.5 m and the covariance's 99.99 % at the end; a pose is wrong in silence where it is outside of
that covariance while the state is OK.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SIDE, LANDMARKS, REACH, FIELD = 20.0, 40, 8.0, 2.0
FORWARD, ACROSS, TURN, SPIN = 0.05, 0.02, 0.05, 0.05
RANGE, BEARING = 0.05, 0.01
OUTSIDE = 18.4
"""Chi-square with 2 degrees of freedom, 99.99 %."""


def landmarks_of(rng: np.random.Generator) -> Array:
    """Returns landmarks (N, 2) along the sides of the square, 0.8 m apart at least."""
    found: list[Array] = []
    while len(found) < LANDMARKS:
        side, along, across = rng.integers(4), rng.uniform(0, SIDE), rng.uniform(-3, 3)
        corner, turn = [(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE)][side], side * math.pi / 2
        c, s = math.cos(turn), math.sin(turn)
        point = np.array([corner[0] + c * along - s * across, corner[1] + s * along + c * across])
        if all(np.linalg.norm(point - one) > 0.8 for one in found):
            found.append(point)
    return np.array(found)


def steps_of() -> list[tuple[float, float]]:
    """Returns the way and the turn of every tenth of a second, at 1 m/s."""
    side = [(0.1, 0.0)] * 200 + [(0.0, math.pi / 20)] * 10
    return side * 8


def drive(seed: int, noise: float) -> tuple[Array, Any, float]:
    """Returns of every step the error (m), its normalised square and whether the state is OK; the filter; CPU seconds.

    `noise`: standard deviations of the odometry over what the filter is told.
    """
    from operators.slam.landmarks.filter import LandmarkFilter

    rng = np.random.default_rng(seed)
    landmarks, made, pose, rows = landmarks_of(rng), LandmarkFilter(), np.zeros(3), []
    began = time.process_time()
    for k, (way, turn) in enumerate(steps_of()):
        pose = pose + np.array([way * math.cos(pose[2]), way * math.sin(pose[2]), turn])
        q, a = math.sqrt(way), math.sqrt(turn)
        sigma = np.array([FORWARD * q, ACROSS * q, math.hypot(TURN * q, SPIN * a)])
        step = np.array([way, 0.0, turn]) + noise * sigma * rng.standard_normal(3)
        made.move(step[:2], float(step[2]), np.diag(np.maximum(sigma, 1e-6) ** 2))
        if k % 2 == 0:
            there = landmarks - pose[:2]
            r = np.linalg.norm(there, axis=1)
            b = (np.arctan2(there[:, 1], there[:, 0]) - pose[2] + math.pi) % (2 * math.pi) - math.pi
            seen = (r < REACH) & (np.abs(b) < FIELD)
            r = r[seen] + RANGE * rng.standard_normal(seen.sum())
            b = b[seen] + BEARING * rng.standard_normal(seen.sum())
            c, s = np.cos(b), np.sin(b)
            J = np.stack([np.stack([c, -r * s], -1), np.stack([s, r * c], -1)], -2)
            spread = J @ np.diag([RANGE**2, BEARING**2]) @ J.transpose(0, 2, 1)
            if len(r):
                made.see([-1] * len(r), np.stack([r * c, r * s], -1), spread)
        off = made.position - pose[:2]
        squared = off @ np.linalg.solve(made.pose_covariance()[:2, :2] + 1e-8 * np.eye(2), off)
        rows.append((math.hypot(*off), squared, made.state[0] == "mapped"))
    return np.array(rows), made, time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--noise", type=float, default=1.0, help="noise of the odometry over what the filter is told")
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    right = 0
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        rows, made, cpu = drive(seed, arguments.noise)
        error, squared, ok = rows.T
        outside = squared > OUTSIDE
        good = error[-1] < 0.5 and not outside[-1]
        right += good
        print(
            f"{seed}: {'right' if good else 'WRONG'}, ends {error[-1]:.2f} m off, "
            f"RMSE {np.sqrt((error**2).mean()):.2f}, "
            f"NEES/2 {np.median(squared) / 2:.2f}, {len(made.ids)} landmarks, {made.counts.merged} united, "
            f"OK {ok.mean():.0%}, outside {outside.mean():.1%}, in silence {(outside & (ok > 0)).mean():.1%}, "
            f"{cpu:.1f} s",
            flush=True,
        )
    print(f"{right} of {arguments.seeds} right")


if __name__ == "__main__":
    main()
