"""Absolute and relative errors of a trajectory, as Sturm et al. (IROS 2012) define them.

The tests hold them equal to those of evo (Grupp 2017).
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages.geometry import normalize, quaternion_multiply, quaternion_to_matrix
from operators.association import mutually_nearest

Alignment = Literal["se3", "sim3", "none"]
Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Indices of the first and of the second pose of each pair."""

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
SPAN_TOLERANCE = 0.1
"""Largest difference between the path of two poses and the span that is asked for, as a share of it."""


@dataclass(eq=False)
class Trajectory:
    """Poses in the order of their stamps (ns): positions (3,) in metres, orientations (4,) as x, y, z, w."""

    stamps: list[int]
    positions: list[NDArray[np.float64]]
    orientations: list[NDArray[np.float64]]

    def __len__(self) -> int:
        return len(self.stamps)

    def select(self, indices: Sequence[int]) -> Trajectory:
        return Trajectory(
            [self.stamps[i] for i in indices],
            [self.positions[i] for i in indices],
            [self.orientations[i] for i in indices],
        )

    def tum(self) -> str:
        """The TUM format, a line a pose: seconds (exact to the nanosecond), x y z, qx qy qz qw."""
        lines = ["# timestamp tx ty tz qx qy qz qw"]
        for stamp, p, q in zip(self.stamps, self.positions, self.orientations, strict=True):
            seconds, rest = divmod(stamp, 10**9)
            lines.append(f"{seconds}.{rest:09d} " + " ".join(repr(float(x)) for x in (*p, *q)))
        return "\n".join(lines) + "\n"


class PoseLog:
    """Collects poses in the order of their stamps, at 64 bytes each, so that a score may last for hours."""

    def __init__(self) -> None:
        self._stamps, self._values = array("q"), array("d")

    def append(self, stamp: int, position: NDArray[np.float64], orientation: NDArray[np.float64]) -> None:
        self._stamps.append(stamp)
        self._values.extend((*position, *orientation))

    def trajectory(self) -> Trajectory:
        """All poses so far."""
        values = np.array(self._values, np.float64).reshape(-1, 7)
        return Trajectory(self._stamps.tolist(), list(values[:, :3]), list(values[:, 3:]))


@dataclass(frozen=True)
class Matches:
    """An estimate and the truth at its stamps, pose by pose, and how many of each found no partner."""

    estimate: Trajectory
    truth: Trajectory
    unmatched_estimates: int
    unmatched_truths: int


def match(estimate: Trajectory, truth: Trajectory, tolerance: int) -> Matches:
    """Pairs poses that are each other's nearest in time and at most `tolerance` ns apart."""
    pairs = mutually_nearest(estimate.stamps, truth.stamps, tolerance)
    return Matches(
        estimate.select([i for i, _ in pairs]),
        truth.select([j for _, j in pairs]),
        len(estimate) - len(pairs),
        len(truth) - len(pairs),
    )


def few_matched(matches: Matches, estimate: Trajectory, truth: Trajectory, tolerance: int) -> str | None:
    """Returns why figures mean little where fewer than half of what could have a partner has one; None where enough
    has."""
    possible = min(len(estimate), len(truth))
    if not possible or 2 * len(matches.estimate) >= possible:
        return None
    spans = [f"{t.stamps[0] * 1e-9:.3f} to {t.stamps[-1] * 1e-9:.3f} s" for t in (estimate, truth)]
    return (
        f"only {len(matches.estimate):,} of {possible:,} poses have a partner within {tolerance * 1e-6:g} ms: stamps "
        f"of the estimate run from {spans[0]}, of the truth from {spans[1]}"
    )


def align(
    points: NDArray[np.float64], onto: NDArray[np.float64], *, scaled: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """R (3, 3), t (3,) and s that minimise Σ |ontoᵢ − (s R pointsᵢ + t)|² (Umeyama, PAMI 1991).

    `points`, `onto`: (N, 3) in metres. s is 1 unless `scaled`. Raises ValueError where the points of either lie on a
    line or in one place, so that no one rotation is best.
    """
    middle, target = points.mean(axis=0), onto.mean(axis=0)
    spread = points - middle
    U, singular, Vt = np.linalg.svd((onto - target).T @ spread / len(points))
    if np.count_nonzero(singular > np.finfo(np.float64).eps) < 2:
        raise ValueError("the positions lie on a line or in one place")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])  # a rotation, never a reflection
    R = (U * signs) @ Vt
    s = float(singular @ signs / np.square(spread).sum(axis=1).mean()) if scaled else 1.0
    return R, target - s * (R @ middle), s


def absolute_error(matches: Matches, alignment: Alignment) -> dict[str, float]:
    """ATE: `ate_rmse_m`, `ate_median_m`, `ate_max_m` of the positions, after aligning the estimate to the truth.

    Needs one pair without alignment, otherwise three that are not on one line. Raises ValueError.
    """
    needed = 1 if alignment == "none" else 3
    if len(matches.estimate) < needed:
        raise ValueError(f"the absolute error with alignment {alignment!r} needs {needed} matched poses or more")
    estimate, truth = np.array(matches.estimate.positions), np.array(matches.truth.positions)
    figures = {}
    if alignment != "none":
        try:
            R, t, scale = align(estimate, truth, scaled=alignment == "sim3")
        except ValueError as error:
            raise ValueError(f"the estimate cannot be aligned to the truth by {alignment!r}: {error}") from None
        estimate = scale * estimate @ R.T + t
        if alignment == "sim3":
            figures["ate_scale"] = scale
    errors = np.linalg.norm(estimate - truth, axis=1)
    statistics = {"rmse": _rmse(errors), "median": float(np.median(errors)), "max": float(errors.max())}
    return {f"ate_{name}_m": value for name, value in statistics.items()} | figures


def relative_errors(matches: Matches, seconds: float, metres: float) -> dict[str, float]:
    """RPE over all pairs `seconds` and `metres` of the true path apart: translation (m) and rotation (deg), RMSE.

    A span that the trajectory does not contain is left out. Time is counted in frames of the median interval.
    """
    count = len(matches.estimate)
    if count < 2:
        return {}
    interval = float(np.median(np.diff(matches.estimate.stamps))) * 1e-9
    frames = max(1, round(seconds / interval))
    figures: dict[str, float] = {}
    spans = ((f"{seconds:g}s", frames_apart(count, frames)), (f"{metres:g}m", metres_apart(matches.truth, metres)))
    for name, pairs in spans:
        if not len(pairs[0]):
            continue
        translations, rotations = _relative_error(matches, pairs)
        figures[f"rpe_{name}_rmse_m"] = _rmse(translations)
        figures[f"rpe_{name}_rmse_deg"] = _rmse(rotations)
    return figures


def segment_drift(matches: Matches, lengths: Sequence[float]) -> dict[str, float]:
    """Drift as KITTI defines it (Geiger et al., CVPR 2012): mean error of segments of the true path by their length.

    `drift_percent` and `drift_deg_per_m` over all segments of the given lengths (m) that begin at every tenth pose;
    `drift_segments` is their number. Empty where the path is shorter than all of them.
    """
    steps = np.linalg.norm(np.diff(np.array(matches.truth.positions).reshape(-1, 3), axis=0), axis=1)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    first, second, spans = [], [], []
    for i in range(0, len(matches.truth), 10):
        for length in lengths:
            j = int(np.searchsorted(travelled, travelled[i] + length, side="right"))
            if j < len(matches.truth):
                first.append(i)
                second.append(j)
                spans.append(length)
    if not first:
        return {}
    translations, rotations = _relative_error(matches, (np.array(first, np.intp), np.array(second, np.intp)))
    return {
        "drift_percent": float((translations / spans).mean() * 100),
        "drift_deg_per_m": float((rotations / spans).mean()),
        "drift_segments": len(first),
    }


def frames_apart(count: int, frames: int) -> Pairs:
    """All pairs of `count` poses that are so many frames apart."""
    first = np.arange(max(0, count - frames))
    return first, first + frames


def metres_apart(trajectory: Trajectory, metres: float) -> Pairs:
    """For each pose the later one at `metres` along the path, as near as there is within `SPAN_TOLERANCE` of it."""
    steps = np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1)
    travelled = np.concatenate(([0.0], np.cumsum(steps)))
    first, second = [], []
    for i in range(len(travelled) - 1):
        distances = travelled[i + 1 :] - travelled[i]
        nearest = int(np.argmin(np.abs(distances - metres)))
        if abs(distances[nearest] - metres) <= metres * SPAN_TOLERANCE:
            first.append(i)
            second.append(i + 1 + nearest)
    return np.array(first, np.intp), np.array(second, np.intp)


def _relative_error(matches: Matches, pairs: Pairs) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Length (m) and angle (deg) of (Q₁⁻¹ Q₂)⁻¹ (P₁⁻¹ P₂) for each pair of the truth Q and the estimate P."""
    turned, moved = _motions(matches.estimate, pairs)
    truly_turned, truly_moved = _motions(matches.truth, pairs)
    translations = np.linalg.norm(moved - truly_moved, axis=1)  # a rotation before it changes no length
    apart = quaternion_multiply(truly_turned * _CONJUGATE, turned)
    angles = 2 * np.arctan2(np.linalg.norm(apart[:, :3], axis=1), np.abs(apart[:, 3]))
    return translations, np.degrees(angles)


def _motions(trajectory: Trajectory, pairs: Pairs) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Quaternion and translation from the first to the second pose of each pair, in the first's own frame."""
    first, second = pairs
    positions, orientations = np.array(trajectory.positions), normalize(trajectory.orientations)
    back = orientations[first] * _CONJUGATE
    moved = quaternion_to_matrix(back) @ (positions[second] - positions[first])[:, :, None]
    return quaternion_multiply(back, orientations[second]), moved[:, :, 0]


def _rmse(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.square(errors).mean()))


def path_length(trajectory: Trajectory) -> float:
    """Metres travelled."""
    if len(trajectory) < 2:
        return 0.0
    return float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())
