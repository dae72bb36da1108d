"""Does `dataflow compare` find a change of half a point of AP in 40 worlds, and none where there is none?

python benchmarks/compare.py [--times 200] [--found 40]

A world has frames of boxes, some of which are hard to find; worlds differ by 10 points of AP. A version of a detector
finds what is easier than its skill, shifted a little for each box and version; AP50 is COCO's, by `DetectionScore`. B
has a little more skill than A; A' has A's, so their scores differ by the shifts alone.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, mannwhitneyu, wilcoxon

from dataflow.sweep.paired import Paired, compared
from operators.evaluation.detection_score import ScoredFrame, score_frames

WORLDS, FRAMES, BOXES = 40, 6, 16
SHIFT = 0.007
"""Standard deviation of what one version finds harder in a box than another; difficulties lie between 0 and 1."""
BETTER = 0.0052
"""Difficulty to which B finds more."""
FIGURE = "detector: ap50"


def ap50(world: int, hardness: float, version: int, skill: float) -> float:
    """AP50 of one version of a detector in a world, in points."""
    there, shifts, frames = np.random.default_rng(world), np.random.default_rng([world, version]), []
    for _ in range(FRAMES):
        corners = there.uniform(0, 500, (BOXES, 2))
        truth = np.hstack([corners, corners + there.uniform(20, 100, (BOXES, 2))])
        margin = skill - hardness - there.uniform(0, 1, BOXES) - shifts.normal(0, SHIFT, BOXES)
        found = truth[margin > 0]
        scores = np.clip(margin[margin > 0], 0, 1).astype(np.float32)
        label, none = ("thing",), np.zeros(BOXES, bool)
        frames.append(ScoredFrame(truth, label * BOXES, none, found, label * len(found), scores))
    told = score_frames(frames, ["thing"], max_detections=100, iou=0.5, score_threshold=0.5)["thing"].ap50
    return 100 * (told or 0.0)


def scores(first: int, version: int, skill: float = 1.0) -> NDArray[np.float64]:
    """AP50 of a version in each of 40 worlds."""
    hardness = np.random.default_rng(first).normal(0.4, 0.1, WORLDS).clip(0.1, 0.7)
    return np.array([ap50(first + k, hardness[k], version, skill) for k in range(WORLDS)])


def judged(a: NDArray[np.float64], b: NDArray[np.float64]) -> Paired:
    """Returns the verdict of `dataflow compare`; its p is that of scipy."""
    (one,) = compared({FIGURE: {f"world {k}": pair for k, pair in enumerate(zip(a, b, strict=True))}})
    assert one.p == float(wilcoxon(b - a).pvalue)
    return one


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=200, help="of A against A'")
    parser.add_argument("--found", type=int, default=40, help="of A against B")
    given = parser.parse_args()
    gains, found, unpaired, alarms, spread = [], 0, 0, 0, []
    for k in range(max(given.times, given.found)):
        first = 1000 * (k + 1)
        a = scores(first, 1)
        spread.append(float(a.std()))
        if k < given.times:
            alarms += judged(a, scores(first, 3)).differs
        if k < given.found:
            b = scores(first, 2, 1.0 + BETTER)
            gains.append(float((b - a).mean()))
            found += judged(a, b).differs
            unpaired += mannwhitneyu(a, b).pvalue < 0.05
    print(f"{WORLDS} worlds, AP50 spread by {np.mean(spread):.1f} points; B - A {np.mean(gains):+.2f} points")
    print(f"B differs from A: in pairs {found} of {given.found}, between means {unpaired} of {given.found}")
    print(f"A' differs from A: in pairs {alarms} of {given.times} (5 % are {0.05 * given.times:.0f})")
    return int(alarms > binom.ppf(0.99, given.times, 0.05) or found < 0.8 * given.found)


if __name__ == "__main__":
    raise SystemExit(main())
