"""Output of the localisation: estimates, planar motions, and the status of filter and sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Odometry
from dataflow.messages.diagnostics import Level
from dataflow.messages.geometry import quaternion_from_yaw, transform_matrix, yaw_of
from operators.localization.particles import wrapped
from operators.localization.says import CONSISTENT

if TYPE_CHECKING:
    from operators.localization.vote import Vote

Array = NDArray[np.float64]
Word = Literal["waiting", "searching", "ambiguous", "localised", "lost"]
_LEVELS = {
    "localised": Level.OK,
    "ambiguous": Level.WARN,
    "searching": Level.WARN,
    "waiting": Level.WARN,
    "lost": Level.ERROR,
}
_APART = 16.27
"""Chi-square with 3 degrees of freedom, 99.9 %."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A pose (3,) with covariance (3, 3), the share of the weight that it has, and whether it is to be believed.

    `other`: another place (3,) that explains what was observed about as well.
    """

    word: Word
    mean: Array
    covariance: Array
    share: float
    other: Array | None = None


def planar(pose: Array) -> Array:
    """Returns the rigid motion (4, 4) of a pose (x, y, yaw)."""
    return transform_matrix([pose[0], pose[1], 0.0], quaternion_from_yaw(pose[2]))


def flat(odometry: Odometry) -> Array:
    """Returns the pose in the plane, as a rigid motion (4, 4)."""
    return planar(np.array([*odometry.position[:2], float(yaw_of(odometry.orientation))]))


def apart(first: Estimate, second: Estimate) -> bool:
    """Says whether two estimates, both to be believed, contradict each other."""
    if first.word != "localised" or second.word != "localised":
        return False
    off = first.mean - second.mean
    off[2:] = wrapped(off[2:])
    spread = first.covariance + second.covariance + np.diag([0.03**2, 0.03**2, 0.02**2])
    return float(off @ np.linalg.solve(spread, off)) > _APART


def written(pose: Array) -> str:
    """Returns a pose (3,) as text."""
    x, y, yaw = pose
    return f"{x:.3f} {y:.3f} {yaw:.3f}"


def status_of(
    stamp: int, fused: Estimate, filter: Vote, modalities: Mapping[str, Vote], ignored: Mapping[str, int]
) -> Diagnostics:
    """Returns a status for the filter, one for every sensor, and one for every modality beside the fused estimate."""
    figures = {**filter.figures(), "share in one place": f"{fused.share:.2f}", "injected": str(filter.injected)}
    if fused.other is not None:
        figures |= {"other place": written(fused.other), "likelier than the other": f"{filter.rival.lead:.1f} nats"}
    figures |= {f"ignored, {reason}": str(count) for reason, count in sorted(ignored.items())}
    said = "ambiguous: another place explains as much" if fused.other is not None else fused.word
    rows: list[tuple[str, str, Level, dict[str, str]]] = [("filter", said, _LEVELS[fused.word], figures)]
    counts = filter.says.counts(stamp)
    for sensor, fit in sorted(filter.fits().items()):
        ratio, count = filter.says.ratio(sensor), counts.get(sensor, 1.0)
        text = "consistent" if ratio <= CONSISTENT else "innovations larger than usual"
        if count < 1:
            text = "disagrees with the others and counts less"
        level = Level.OK if ratio <= CONSISTENT else Level.WARN
        rows.append(
            (sensor, text, level, {"counts": f"{count:.3f}", "innovations": f"{ratio:.2f}", "fit": f"{fit:.2f}"})
        )
    for name, vote in modalities.items():
        if vote.begun:
            own = vote.estimate()
            off = apart(own, fused)
            text = "contradicts the fused estimate" if off else own.word
            places = {"pose": written(own.mean)} | ({} if own.other is None else {"other place": written(own.other)})
            rows.append((f"{name} alone", text, Level.WARN if off else Level.OK, places))
    pairs = [(key, value, k) for k, row in enumerate(rows) for key, value in row[3].items()]
    return Diagnostics(
        stamp=stamp,
        names=tuple(row[0] for row in rows),
        messages=tuple(row[1] for row in rows),
        levels=np.array([row[2] for row in rows], np.uint8),
        keys=tuple(key for key, _, _ in pairs),
        values=tuple(value for _, value, _ in pairs),
        owners=np.array([owner for _, _, owner in pairs], np.int32),
    )
