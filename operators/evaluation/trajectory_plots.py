"""Draws the errors of a trajectory while they arise: as curves, and as one picture of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Image, Number, Odometry, Pose
from dataflow.messages.geometry import invert, matrix_to_quaternion
from dataflow.operator import Batch, Duration, In, Operator, Out, Param, Sampled
from operators.estimation.chi_square import quantile
from operators.evaluation.charts import Curve, chart, plan, tiled
from operators.evaluation.consistency import Innovations, covariance_of, innovations, normalised, pose_error
from operators.evaluation.figures import Figures

Array = NDArray[np.float64]
_PARTS = {"position": (0, 1, 2), "orientation": (3, 4, 5)}


class TrajectoryPlots(Figures, Operator):
    """Gives the error of every pose against the truth as curves, and a picture of all so far every `period`.

    The picture holds the tracks from above, the error of the position beside three of its standard deviations, the
    normalised errors squared (NEES) over their freedom with the bound of 95 %, and the normalised innovations squared
    (NIS) of each sensor, second by second, where a filter's status is given. It is drawn without a plotting library.
    The figures themselves are those of TrajectoryMetrics and ConsistencyMetrics.
    """

    estimate: In[Pose | Odometry] = In(doc="the poses to score")
    ground_truth: Batch[Pose | Odometry] = Batch(doc="the true poses of the same child frame, not later than they are")
    status: Sampled[Diagnostics] = Sampled(required=False, doc="the filter's status, with its innovations")
    error: Out[Number] = Out(doc="distance from the true position, m")
    turn: Out[Number] = Out(doc="angle from the true orientation, degrees")
    nees: Out[Number] = Out(doc="normalised error squared of the pose, over its degrees of freedom")
    picture: Out[Image] = Out(doc="everything so far as one picture, every `period`")

    alignment: Literal["none", "origin"] = Param(
        "none", doc="compares poses as they are, or after moving the first of them onto its truth"
    )
    tolerance: Duration = Param("1ms", doc="farthest in time that an estimate's truth may be")
    period: Duration = Param("5s", doc="time between two pictures")
    size: tuple[int, int] = Param((720, 400), doc="width and height of each of the four charts, pixels")
    out: str = Param("", doc="folder for plots.png, written at the end, made if missing; no file where empty")

    def setup(self) -> None:
        """Raises ValueError for charts that are too small to be read."""
        if min(self.size) < 160:
            raise ValueError(f"size {self.size}: a chart needs 160 pixels and more each way")
        self._truth: Pose | Odometry | None = None
        self._moved: Array | None = None
        self._rows: list[tuple[float, float, float]] = []  # seconds, metres, three standard deviations
        self._nees: dict[str, list[tuple[float, float]]] = {name: [] for name in _PARTS}
        self._tracks: dict[str, list[Array]] = {"estimate": [], "truth": []}
        self._told: Innovations = {}
        self._nis: dict[str, list[tuple[float, float]]] = {}
        self._told_at = self._shown = -1
        self._unpaired = 0

    def process(
        self, estimate: Pose | Odometry, ground_truth: tuple[Pose | Odometry, ...], status: Diagnostics | None = None
    ) -> Mapping[str, Any]:
        """Raises ValueError where estimate and truth pose different child frames."""
        if ground_truth:
            self._truth = ground_truth[-1]
        if status is not None and status.stamp > self._told_at:
            self._told_at = status.stamp
            self._innovate(status)
        truth = self._truth
        far = truth is None or abs(estimate.stamp - truth.stamp) > self.tolerance
        if truth is None or far or not (_finite(estimate) and _finite(truth)):
            self._unpaired += 1
            return {}
        if estimate.child_frame and truth.child_frame and estimate.child_frame != truth.child_frame:
            raise ValueError(
                f"the ground truth poses {truth.child_frame!r} but the estimate {estimate.child_frame!r}: both must "
                "pose the same frame"
            )
        made = self._compared(estimate, truth)
        if self._shown < 0:
            self._shown = estimate.stamp
        if estimate.stamp - self._shown >= self.period:
            self._shown = estimate.stamp
            made["picture"] = Image(stamp=estimate.stamp, frame="plots", data=self._drawn())
        return made

    def finish(self) -> None:
        """Writes the picture of everything."""
        if not self.out or not self._rows:
            return
        folder = Path(self.out).expanduser()
        folder.mkdir(parents=True, exist_ok=True)
        file = folder / "plots.png"
        if not cv2.imwrite(str(file), self._drawn()[..., ::-1]):
            raise OSError(f"cannot write {file}")

    def summary(self) -> Mapping[str, float | int | str]:
        return {"compared": len(self._rows), "without truth": self._unpaired}

    def _compared(self, estimate: Pose | Odometry, truth: Pose | Odometry) -> dict[str, Any]:
        stamp, covariance = estimate.stamp, covariance_of(estimate)
        if self.alignment == "origin":
            if self._moved is None:
                self._moved = truth.matrix() @ invert(estimate.matrix())
            T, R = self._moved @ estimate.matrix(), self._moved[:3, :3]
            estimate = Pose(
                stamp=stamp,
                frame=truth.frame,
                child_frame=estimate.child_frame,
                position=T[:3, 3],
                orientation=matrix_to_quaternion(T[:3, :3]),
            )
            if covariance is not None:
                turned = np.kron(np.eye(2), R)
                covariance = turned @ covariance @ turned.T
        error = pose_error(estimate, truth)
        seconds, far = stamp * 1e-9, float(np.linalg.norm(error[:3]))
        spread = 0.0 if covariance is None else 3.0 * float(np.sqrt(max(np.trace(covariance[:3, :3]), 0.0)))
        self._rows.append((seconds, far, spread))
        self._tracks["estimate"].append(estimate.position[:2])
        self._tracks["truth"].append(truth.position[:2])
        made: dict[str, Any] = {
            "error": Number(stamp=stamp, value=far, unit="m"),
            "turn": Number(stamp=stamp, value=float(np.degrees(np.linalg.norm(error[3:]))), unit="deg"),
        }
        if covariance is not None:
            for part, axes in _PARTS.items():
                if (one := normalised(error, covariance, axes)) is not None:
                    self._nees[part].append((seconds, one[0] / one[1]))
            if (whole := normalised(error, covariance, range(6))) is not None:
                made["nees"] = Number(stamp=stamp, value=whole[0] / whole[1])
        return made

    def _innovate(self, status: Diagnostics) -> None:
        told = innovations(status)
        for sensor, (total, freedom) in told.items():
            before, already = self._told.get(sensor, (0.0, 0))
            if freedom > already:
                ratio = (total - before) / (freedom - already)
                self._nis.setdefault(sensor, []).append((status.stamp * 1e-9, ratio))
        self._told = told

    def _drawn(self) -> NDArray[np.uint8]:
        begin = self._rows[0][0]
        seconds, far, spread = np.array(self._rows).T
        seconds = seconds - begin
        tracks = [Curve(name, *np.array(rows).T) for name, rows in self._tracks.items()]
        errors = [Curve("error", seconds, far)]
        if spread.any():
            errors.append(Curve("3 sigma", seconds, spread, limit=True))
        nees = [_curve(part, rows, begin) for part, rows in self._nees.items() if rows]
        nis = [_curve(sensor, rows, begin) for sensor, rows in sorted(self._nis.items())]
        bound = float(quantile(0.95, 3)) / 3
        size, ends = self.size, np.array([0.0, float(seconds[-1])])
        charts = [
            plan("from above, m", tracks, size),
            chart("position error, m over s", errors, size, top=3.0 * float(far.max()) + 1e-6),
            chart(
                "NEES over freedom, 1 if honest",
                [*nees, Curve("95 %", ends, np.full(2, bound), limit=True)],
                size,
                top=12.0,
            ),
            chart(
                "NIS over freedom of each second, 1 if honest",
                [*nis, Curve("1", ends, np.ones(2), limit=True)],
                size,
                top=6.0,
            ),
        ]
        return tiled(charts)


def _curve(name: str, rows: list[tuple[float, float]], begin: float) -> Curve:
    x, y = np.array(rows).T
    return Curve(name, x - begin, y)


def _finite(estimate: Pose | Odometry) -> bool:
    return bool(np.isfinite(estimate.position).all() and np.isfinite(estimate.orientation).all())
