"""Absolute and relative errors of a trajectory, by evo (Grupp 2017), as Sturm et al. (IROS 2012) define them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from operators.association import mutually_nearest

if TYPE_CHECKING:
    from evo.core.trajectory import PoseTrajectory3D

Alignment = Literal["se3", "sim3", "none"]


@dataclass(eq=False)
class Trajectory:
    """Poses in the order of their stamps (ns): positions (3,) in metres, orientations (4,) as x, y, z, w."""

    stamps: list[int]
    positions: list[NDArray[np.float64]]
    orientations: list[NDArray[np.float64]]

    @classmethod
    def empty(cls) -> Trajectory:
        return cls([], [], [])

    def __len__(self) -> int:
        return len(self.stamps)

    def append(self, stamp: int, position: NDArray[np.float64], orientation: NDArray[np.float64]) -> None:
        self.stamps.append(stamp)
        self.positions.append(position)
        self.orientations.append(orientation)

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


def absolute_error(matches: Matches, alignment: Alignment) -> dict[str, float]:
    """ATE: `ate_rmse_m`, `ate_median_m`, `ate_max_m` of the positions, after aligning the estimate to the truth.

    Needs one pair without alignment, otherwise three that are not all in one place. Raises ValueError.
    """
    from evo.core.geometry import GeometryException
    from evo.core.metrics import APE, PoseRelation

    needed = 1 if alignment == "none" else 3
    if len(matches.estimate) < needed:
        raise ValueError(f"the absolute error with alignment {alignment!r} needs {needed} matched poses or more")
    estimate, truth = _evo(matches.estimate), _evo(matches.truth)
    figures = {}
    if alignment != "none":
        try:
            _, _, scale = estimate.align(truth, correct_scale=alignment == "sim3")
        except GeometryException as error:
            raise ValueError(f"the estimate cannot be aligned to the truth by {alignment!r}: {error}") from None
        if alignment == "sim3":
            figures["ate_scale"] = float(scale)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((truth, estimate))
    statistics = metric.get_all_statistics()
    return {f"ate_{name}_m": float(statistics[name]) for name in ("rmse", "median", "max")} | figures


def relative_errors(matches: Matches, seconds: float, metres: float) -> dict[str, float]:
    """RPE over all pairs `seconds` and `metres` of the true path apart: translation (m) and rotation (deg), RMSE.

    A span that the trajectory does not contain is left out. Time is counted in frames of the median interval.
    """
    from evo.core.filters import FilterException
    from evo.core.metrics import RPE, PoseRelation, Unit

    figures: dict[str, float] = {}
    if len(matches.estimate) < 2:
        return figures
    estimate, truth = _evo(matches.estimate), _evo(matches.truth)
    interval = float(np.median(np.diff(matches.estimate.stamps))) * 1e-9
    frames = max(1, round(seconds / interval))
    spans = ((f"{seconds:g}s", frames, Unit.frames), (f"{metres:g}m", metres, Unit.meters))
    for name, delta, unit in spans:
        relations = ((PoseRelation.translation_part, "m"), (PoseRelation.rotation_angle_deg, "deg"))
        for relation, symbol in relations:
            metric = RPE(relation, delta, unit, all_pairs=True, pairs_from_reference=True)
            try:
                metric.process_data((truth, estimate))
            except FilterException:  # evo's word for: no two poses are so far apart
                continue
            figures[f"rpe_{name}_rmse_{symbol}"] = float(metric.get_all_statistics()["rmse"])
    return figures


def path_length(trajectory: Trajectory) -> float:
    """Metres travelled."""
    if len(trajectory) < 2:
        return 0.0
    return float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())


def _evo(trajectory: Trajectory) -> PoseTrajectory3D:
    from evo.core.trajectory import PoseTrajectory3D

    start = trajectory.stamps[0]
    return PoseTrajectory3D(
        positions_xyz=np.array(trajectory.positions),
        orientations_quat_wxyz=np.roll(np.array(trajectory.orientations), 1, axis=1),
        timestamps=np.array([(stamp - start) * 1e-9 for stamp in trajectory.stamps]),
    )
