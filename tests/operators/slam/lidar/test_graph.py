"""The map of LiDAR scans, with sights that are made: when a saved map counts as found."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from dataflow.messages.geometry import invert
from operators.cloud.registration import failure
from operators.geometry.se3 import Matrix
from operators.slam.keyframe_graph import SAVED, Node
from operators.slam.lidar.graph import LOOKS, LidarGraph, LidarSettings
from operators.slam.lidar.view import LidarSight, LidarView
from operators.slam.sensor_model import KeyframeResult
from tests.support.made_scans import at

SMALL = np.diag([1e-4] * 6)
ENDS = 0.0, 20.0  # metres along a corridor


def view(seed: int, noise: float) -> LidarView:
    """A place whose walls have heights that differ a little from those of every other."""
    angles = np.linspace(-np.pi, np.pi, 240, endpoint=False)
    heights = np.random.default_rng(0).uniform(0, 2, 240) + noise * np.random.default_rng(seed).normal(0, 1, 240)
    points = np.column_stack([4 * np.cos(angles), 4 * np.sin(angles), heights])
    return LidarView(points.astype(np.float32), 10.0, 0.1)


class Corridor:
    """Eyes that see a scan near the views of one end, and of the other where both look alike."""

    def __init__(self, *, both: bool) -> None:
        self._both, self.looks = both, 0

    def distance(self, T_a: Matrix, T_b: Matrix) -> float:
        return float(np.linalg.norm((invert(T_a) @ T_b)[:3, 3]))

    def sight(self, nodes: Mapping[int, Node[LidarView]], known: int, seen: int, expected: bool) -> LidarSight | str:
        self.looks += 1
        far = bool(nodes[known].T[0, 3] > sum(ENDS) / 2)
        if far and not self._both:
            return "another end"
        T = at(ENDS[far] + 1.0, 0.3, 0.0) @ nodes[seen].T_odom
        return LidarSight(invert(nodes[known].T) @ T, SMALL, failure(""))


@pytest.mark.parametrize("both", [False, True])
def test_a_map_is_not_found_where_another_part_of_it_explains_the_scan_as_well(both: bool) -> None:
    """The views that look most alike are all at the near end. Few are looked at in one call."""
    nodes = [
        Node(k, at(end + 0.5 * k, 0, 0), SMALL, at(end + 0.5 * k, 0, 0), SMALL, 0.0, SAVED, view(10 * n + k, 0.01 + n))
        for n, end in enumerate(ENDS)
        for k in range(4)
    ]
    eyes = Corridor(both=both)
    graph = LidarGraph(LidarSettings(), eyes)
    graph.begin_in(nodes)
    added, looks = list[KeyframeResult](), [0]
    for k in range(20):
        added.append(graph.add(100 + k, at(0.06 * k, 0, 0), SMALL, view(50, 0.01), 0, False))
        looks.append(eyes.looks)
    assert np.diff(looks).max() == LOOKS
    assert graph.located is not both
    assert [one.found for one in added].count(True) == (not both)
    assert any("ambiguous" in reason for one in added for reason in one.refused) is both
    assert np.allclose(graph.T_map_odom[:2, 3], (0.0, 0.0) if both else (1.0, 0.3), atol=1e-6)


def test_rivals_of_a_place_are_looked_at_before_the_scan_that_confirms_it() -> None:
    """Four views of the place, and a dozen views elsewhere; a keyframe at every fifth scan."""
    places = [0.5 * k for k in range(4)] + [20.0 + 1.5 * k for k in range(12)]
    nodes = [
        Node(k, at(x, 0, 0), SMALL, at(x, 0, 0), SMALL, 0.0, SAVED, view(k, 0.01 if x < 10 else 1.0))
        for k, x in enumerate(places)
    ]
    eyes = Corridor(both=False)
    graph = LidarGraph(LidarSettings(), eyes)
    graph.begin_in(nodes)
    looks, found = [0], list[bool]()
    for k in range(12):
        found.append(graph.add(100 + k, at(0.06 * k, 0, 0), SMALL, view(50, 0.01), 0, False).found)
        looks.append(eyes.looks)
    assert np.diff(looks).max() == LOOKS
    assert eyes.looks == 3 + 12 + 3  # views of two scans, and rivals of the first
    assert found.index(True) == 8
