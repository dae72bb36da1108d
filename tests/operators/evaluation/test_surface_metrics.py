"""SurfaceMetrics on surfaces whose distances from the true one are known."""

from __future__ import annotations

import numpy as np
import pytest

from dataflow.execution.failure import OperatorFailure
from dataflow.messages import Mesh, PointCloud
from dataflow.testing import play
from operators.evaluation import SurfaceMetrics


def sheet(height: float = 0.0, width: float = 4.0, stamp: int = 1, frame: str = "world") -> Mesh:
    """A level rectangle from the origin, 2 m deep."""
    corners = [[0, 0, height], [width, 0, height], [width, 2, height], [0, 2, height]]
    return Mesh(
        stamp=stamp, frame=frame, vertices=np.array(corners), triangles=np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    )


def scored(found: list[Mesh | PointCloud], true: Mesh | PointCloud, **params: object) -> dict[str, float | int | str]:
    metrics = SurfaceMetrics(**params)
    play(metrics, {"surface": found, "truth": [true]})
    return dict(metrics.summary())


def test_half_of_a_surface_is_precise_and_incomplete() -> None:
    figures = scored([sheet(width=2.0)], sheet())
    assert figures["precision"] == 1.0
    assert figures["recall"] == pytest.approx((2 + 0.05) / 4, abs=0.01)
    assert figures["completeness_m"] == pytest.approx(0.5, abs=0.03)  # 0 to 2 m over half of it
    assert figures["accuracy_m"] < 0.01
    share = float(figures["recall"])
    assert figures["f_score"] == pytest.approx(2 * share / (1 + share))


@pytest.mark.parametrize(("height", "right"), [(0.03, 1.0), (0.08, 0.0)])
def test_a_surface_is_right_within_the_distance(height: float, right: float) -> None:
    figures = scored([sheet(height)], sheet())
    assert figures["accuracy_m"] == pytest.approx(height, abs=0.003)
    assert (figures["precision"], figures["recall"], figures["f_score"]) == (right, right, right)


def test_the_last_surface_is_scored_and_clouds_count_as_they_are() -> None:
    grid = np.stack(np.meshgrid(np.linspace(0, 4, 81), np.linspace(0, 2, 41), [0.0]), axis=-1).reshape(-1, 3)
    points = np.concatenate([grid, [[1, 1, 0.2], [np.nan, 0, 0]]])
    cloud = PointCloud(stamp=5, frame="world", points=points.astype(np.float32))
    figures = scored([sheet(height=1.0), cloud], sheet())
    assert figures["surfaces"] == 2
    assert figures["precision"] == pytest.approx(1 - 1 / (len(points) - 1))
    assert figures["recall"] == 1.0


def test_another_frame_an_empty_surface_and_none_at_all_are_named() -> None:
    with pytest.raises(OperatorFailure, match="the surface is in frame 'map', the true one in 'world'"):
        scored([sheet(frame="map")], sheet())
    nothing = PointCloud(stamp=1, frame="world", points=np.zeros((0, 3), np.float32))
    assert scored([nothing], sheet())["f_score"] == "not computed: 0 points of the surface, 50000 true ones"
    assert scored([], sheet())["f_score"] == "not computed: no surface came"


def test_surface_metrics_are_deterministic_despite_sampling() -> None:
    assert scored([sheet(0.01, width=3.0)], sheet()) == scored([sheet(0.01, width=3.0)], sheet())
