"""DepthMetrics on depths whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import DepthImage
from dataflow.testing import play
from operators.evaluation import DepthMetrics


def image(data: object, stamp: int = 1) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=np.asarray(data, np.float32))


def scored(found: list[DepthImage], true: list[DepthImage], **params: object) -> dict[str, float | int | str]:
    metrics = DepthMetrics(**params)
    play(metrics, {"depth": found, "truth": true})
    return dict(metrics.summary())


def test_errors_are_those_of_the_pixels_that_both_have() -> None:
    true = [[2.0, 2.0, 4.0, 4.0, np.nan, 0.0]]
    found = [[2.2, 2.0, 5.2, 0.0, 3.0, 3.0]]
    figures = scored([image(found)], [image(true)])
    assert figures["measured"] == 0.75
    assert figures["rmse_m"] == pytest.approx(np.sqrt((0.04 + 1.44) / 3), rel=1e-6)
    assert figures["mean_relative_error"] == pytest.approx((0.1 + 0.3) / 3, rel=1e-6)
    assert figures["median_relative_error"] == pytest.approx(0.1, rel=1e-5)
    assert figures["within_25_percent"] == pytest.approx(2 / 3)


def test_means_are_over_images_beside_the_worst() -> None:
    true = [image([[2.0]], stamp) for stamp in (10, 20, 30)]
    found = [image([[2.5]], 10), image([[3.0]], 20), image([[0.0]], 30)]
    figures = scored(found, true)
    assert (figures["rmse_m"], figures["worst_rmse_m"]) == (0.75, 1.0)
    assert (figures["frames"], figures["frames_without_depth"]) == (3, 1)


def test_far_truth_and_images_without_a_partner_are_not_judged() -> None:
    assert scored([image([[9.0, 1.0]])], [image([[50.0, 1.0]])], max_range=10.0)["rmse_m"] == 0
    assert str(scored([image([[0.0]])], [image([[1.0]])])["rmse_m"]).startswith("not computed: no pixel")
    figures = scored([image([[1.0]], 10), image([[1.0]], 10**9)], [image([[1.0]], 11)], tolerance="1us")
    assert (figures["frames"], figures["unmatched_depths"], figures["unmatched_truths"]) == (1, 1, 0)


def test_two_sizes_are_an_error() -> None:
    with pytest.raises(OperatorFailure, match=r"depth has \(1, 2\) pixels, but the truth \(1, 1\)"):
        scored([image([[1.0, 1.0]])], [image([[1.0]])])
