"""The status of the localisation: of its filter, its sensors, and each modality beside the fused estimate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics
from dataflow.messages.diagnostics import Level
from operators.localization.estimate import Estimate, apart
from operators.localization.sensor_weights import CONSISTENT
from operators.localization.weighted_cloud import WeightedCloud
from operators.status import Row, status_of_rows

Array = NDArray[np.float64]
_LEVELS = {
    "localised": Level.OK,
    "ambiguous": Level.WARN,
    "searching": Level.WARN,
    "waiting": Level.WARN,
    "lost": Level.ERROR,
}


def written(pose: Array) -> str:
    """Returns a pose (3,) as text."""
    x, y, yaw = pose
    return f"{x:.3f} {y:.3f} {yaw:.3f}"


def status_of(
    stamp: int,
    fused: Estimate,
    filter: WeightedCloud,
    modalities: Mapping[str, WeightedCloud],
    ignored: Mapping[str, int],
) -> Diagnostics:
    """Returns a status for the filter, one for every sensor, and one for every modality beside the fused estimate."""
    figures = {**filter.figures(), "share in one place": f"{fused.share:.2f}", "injected": str(filter.injected)}
    if fused.other is not None:
        figures |= {"other place": written(fused.other), "likelier than the other": f"{filter.competing.lead:.1f} nats"}
    figures |= {f"ignored, {reason}": str(count) for reason, count in sorted(ignored.items())}
    said = "ambiguous: another place explains as much" if fused.other is not None else fused.word
    rows: list[Row] = [("filter", said, _LEVELS[fused.word], figures)]
    counts = filter.sensor_weights.counts(stamp)
    for sensor, fit in sorted(filter.fits().items()):
        ratio, count = filter.sensor_weights.ratio(sensor), counts.get(sensor, 1.0)
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
    return status_of_rows(stamp, rows)
