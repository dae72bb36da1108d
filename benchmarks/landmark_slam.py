"""Landmark SLAM on Victoria Park: the map against the optimum of the whole problem, and the time it takes.

    python benchmarks/landmark_slam.py DATA/landmark_slam/victoria_park.txt --gtsam VENV

VENV is a virtual environment with gtsam and numpy, whose Levenberg-Marquardt optimum, started from the filter's result,
is the reference. Maps are compared after a rigid alignment. Without `--gtsam` only times and counts are printed.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

OPTIMISE = """
import sys
import gtsam
import numpy as np
given = np.load(sys.argv[1])
graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
for k, (x, y, heading) in enumerate(given["poses"]):
    values.insert(k, gtsam.Pose2(x, y, heading))
offset = len(given["poses"])
for k, point in enumerate(given["landmarks"]):
    values.insert(offset + k, gtsam.Point2(*point))
graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-4))))
for k, (motion, covariance) in enumerate(zip(given["motions"], given["covariances"])):
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    graph.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*motion), noise))
for pose, landmark, point, spread in zip(given["seers"], given["seen"], given["points"], given["spreads"]):
    x, y = point
    r = np.hypot(x, y)
    J = np.array([[-y / r**2, x / r**2], [x / r, y / r]])
    noise = gtsam.noiseModel.Gaussian.Covariance(J @ spread @ J.T)
    bearing = gtsam.Rot2(np.arctan2(y, x))
    graph.add(gtsam.BearingRangeFactor2D(int(pose), offset + int(landmark), bearing, r, noise))
result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
rows = 3 * len(given["motions"]) + 2 * len(given["seen"])
freedom = rows - 3 * (offset - 1) - 2 * len(given["landmarks"])
landmarks = [result.atPoint2(offset + k) for k in range(len(given["landmarks"]))]
poses = [(p.x(), p.y(), p.theta()) for p in (result.atPose2(k) for k in range(offset))]
np.savez(sys.argv[2], landmarks=landmarks, poses=poses, fit=2 * graph.error(result) / freedom)
"""


def aligned(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Moves points (N, 2) rigidly onto others, by least squares."""
    a, b = points - points.mean(0), onto - onto.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    R = vt.T @ np.diag([1, np.linalg.det(vt.T @ u.T)]) @ u.T
    return np.asarray(a @ R.T + onto.mean(0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--gtsam", type=Path)
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from operators.slam.landmarks.filter import LandmarkFilter
    from operators.sources.victoria_park import read_steps

    steps = read_steps(arguments.file)
    for known in (True, False):
        made, poses, seers, seen, points, spreads = LandmarkFilter(), [], [], [], [], []
        began, cpu = time.perf_counter(), time.process_time()
        for k, step in enumerate(steps):
            if k:
                made.move(step.motion[:2], float(step.motion[2]), step.covariance)
            if step.ids:
                ids = step.ids if known else [-1] * len(step.ids)
                found = made.see(ids, np.array(step.points), np.array(step.spreads))
                rows = [i for i, landmark in enumerate(found) if landmark >= 0]
                seers += [k] * len(rows)
                seen += [found[i] for i in rows]
                points += [step.points[i] for i in rows]
                spreads += [step.spreads[i] for i in rows]
            poses.append((*made.position, made.heading))
        wall, cpu = time.perf_counter() - began, time.process_time() - cpu
        name = "known" if known else "unknown"
        print(f"{name} association: {len(made.ids)} landmarks, {made.counts}, {wall:.2f} s wall, {cpu:.2f} s CPU")
        if arguments.gtsam is None or not known:
            continue
        with tempfile.TemporaryDirectory() as folder:
            problem, solution = Path(folder) / "problem.npz", Path(folder) / "solution.npz"
            np.savez(
                problem,
                poses=poses,
                landmarks=made.landmarks,
                motions=[s.motion for s in steps[1:]],
                covariances=[s.covariance for s in steps[1:]],
                seers=seers,
                seen=seen,
                points=points,
                spreads=spreads,
            )
            python = arguments.gtsam / "bin" / "python"
            subprocess.run([str(python), "-c", OPTIMISE, str(problem), str(solution)], check=True)
            best = np.load(solution)
            off = np.linalg.norm(aligned(made.landmarks, best["landmarks"]) - best["landmarks"], axis=1)
            way = np.linalg.norm(aligned(np.array(poses)[:, :2], best["poses"][:, :2]) - best["poses"][:, :2], axis=1)
            print(f"  optimum: chi2 / dof {float(best['fit']):.2f}")
            print(f"  map: {math.sqrt((off**2).mean()):.2f} m RMSE, {off.max():.2f} m at most")
            print(f"  path as it was online: {math.sqrt((way**2).mean()):.2f} m RMSE, {way.max():.2f} m at most")


if __name__ == "__main__":
    main()
