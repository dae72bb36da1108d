"""Curves of errors while they arise, and pictures that show what was compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dataflow.messages import Diagnostics, Odometry
from dataflow.testing import Played, play
from operators.evaluation import TrajectoryPlots
from operators.evaluation.charts import COLORS, Curve, chart, plan, steps, tiled

STEP = 100_000_000


def poses(count: int = 40, off: float = 0.0, child: str = "base") -> list[Odometry]:
    return [
        Odometry(
            stamp=(k + 1) * STEP, frame="world", child_frame=child, position=[0.1 * k, off, 0.0],
            orientation=[0, 0, 0, 1], pose_covariance=np.eye(6) * 0.1**2,
        )
        for k in range(count)
    ]  # fmt: skip


def statuses(count: int) -> list[Diagnostics]:
    """A sensor whose innovations are four times those explained from the middle on."""
    made, total = [], 0.0
    for k in range(count):
        total += 30.0 * (4.0 if k >= count // 2 else 1.0)
        made.append(
            Diagnostics(
                stamp=(k + 1) * 10 * STEP, names=("filter", "gnss/fix"), messages=("", ""),
                levels=np.zeros(2, np.uint8), keys=("used", "nis", "freedom"),
                values=("1", f"{total:.3f}", str(30 * (k + 1))), owners=np.array([0, 1, 1], np.int32),
            )
        )  # fmt: skip
    return made


def played(estimate: list[Any], truth: list[Any], **params: Any) -> tuple[Played, TrajectoryPlots]:
    operator = TrajectoryPlots(**params)
    return play(operator, {"estimate": estimate, "ground_truth": truth, "status": statuses(4)}), operator


def test_errors_are_those_of_the_poses() -> None:
    made, operator = played(poses(off=0.3), poses())
    assert [n.value for n in made["error"]] == pytest.approx([0.3] * 40)
    assert [n.value for n in made["turn"]] == pytest.approx([0.0] * 40)
    assert [n.value for n in made["nees"]] == pytest.approx([9.0 / 6] * 40)
    assert operator.summary() == {"compared": 40, "without truth": 0}
    assert dict(operator._nis)["gnss/fix"] == [(1.0, 1.0), (2.0, 1.0), (3.0, 4.0), (4.0, 4.0)]


def test_origin_alignment_removes_a_constant_offset() -> None:
    made, _ = played(poses(off=0.3), poses(), alignment="origin")
    assert max(n.value for n in made["error"]) < 1e-9


def test_a_picture_comes_every_period_and_the_file_holds_everything(tmp_path: Path) -> None:
    made, _ = played(poses(off=0.3), poses(), out=str(tmp_path / "new"), period="1300ms")
    assert [p.stamp for p in made["picture"]] == [14 * STEP, 27 * STEP, 40 * STEP]
    last = made["picture"][-1].data
    assert last.shape == (800, 1440, 3)
    written = cv2.imread(str(tmp_path / "new" / "plots.png"), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_array_equal(written, last)


def test_poses_without_truth_or_not_finite_are_counted_and_the_others_compared() -> None:
    bad = poses()
    bad[3] = bad[3].replace(position=[np.nan, 0, 0])
    bad[4] = bad[4].replace(pose_covariance=np.full((6, 6), np.nan))
    made, operator = played(bad, poses()[:30])
    assert operator.summary() == {"compared": 29, "without truth": 11}
    assert (len(made["error"]), len(made["nees"])) == (29, 28)
    nothing, silent = played(bad, [])
    assert not nothing["picture"]
    assert silent.summary()["without truth"] == 40


def test_poses_of_another_frame_are_refused() -> None:
    with pytest.raises(Exception, match="the ground truth poses 'camera' but the estimate 'base'"):
        played(poses(), poses(child="camera"))
    with pytest.raises(ValueError, match="a chart needs 160 pixels"):
        TrajectoryPlots(size=(100, 300)).setup()


def test_a_chart_shows_its_curves_in_their_colours_and_where_they_are() -> None:
    x = np.linspace(0, 10, 50)
    image = chart("two", [Curve("low", x, 0 * x), Curve("high", x, 0 * x + 5)], (400, 300))
    rows = [np.flatnonzero((image == color).all(axis=2)[60:].any(axis=1)) + 60 for color in COLORS[:2]]
    assert rows[0].max() > 250
    assert 30 < np.flatnonzero((image[:, 100:150] == COLORS[1]).all(axis=2).any(axis=1)).min() < 60
    assert image.shape == (300, 400, 3)


def test_a_plan_has_one_scale() -> None:
    a = np.linspace(0, 2 * np.pi, 200)
    image = plan("circle", [Curve("", np.cos(a), np.sin(a))], (600, 300))
    rows, columns = np.nonzero((image == COLORS[0]).all(axis=2))
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), abs=4)


def test_ticks_are_round_and_empty_charts_are_drawn() -> None:
    assert steps(0.0, 9.7, 6) == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert len(steps(-0.013, 0.017, 8)) <= 8
    assert tiled([chart("", [], (300, 200))] * 3).shape == (400, 600, 3)
