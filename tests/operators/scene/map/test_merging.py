"""When two entries of the map are one thing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from operators.labels import LabelSpace, labels_file
from operators.scene.map.class_priors import ClassPriors
from operators.scene.map.cuboid import CORNERS, ImageView
from operators.scene.map.map_object import MapObject
from operators.scene.map.matching import MapSettings, Observation, in_reach, outside
from operators.scene.map.merging import are_one, may_be_one
from operators.scene.map.voxels import VoxelSet

SIZE = np.array([0.16, 0.04, 0.23])
NAMES = ("book", "mug")
PRIORS = ClassPriors.of(LabelSpace.read(Path(labels_file("simulator"))), NAMES)
VIEW = ImageView(np.eye(3, 4), np.array([0.0, 0.0, 9.0, 9.0]), np.ones(4, np.bool_), np.zeros(3))


def entry(id: int, y: float, class_id: int = 0) -> MapObject:
    """An entry of a book that was seen in twenty views."""
    made = MapObject(id, VoxelSet(0.03), np.eye(len(NAMES))[class_id], 3.0, 0, 0, views=20)
    made.center, made.size, made.images = np.array([2.0, y, 1.0]), SIZE.copy(), [VIEW]
    made.voxels = VoxelSet.of_each([CORNERS * SIZE + made.center], 0.03)[0]
    return made


@pytest.mark.parametrize(
    ("classes", "shared", "beside", "one"),
    [
        (1, 0.1, 0, False), (1, 0.2, 0, True), (1, 0.2, 2, True), (1, 0.2, 4, False), (1, 0.4, 4, True),
        (1, 0.4, 20, True), (2, 0.3, 0, False), (2, 0.45, 0, True), (2, 0.45, 4, False),
    ],
)  # fmt: skip
def test_overlapping_entries_are_merged_unless_seen_side_by_side(
    classes: int, shared: float, beside: int, one: bool
) -> None:
    a, b = entry(1, 0.0), entry(2, 0.04 * (1 - shared), classes - 1)
    a.beside[2] = beside
    assert are_one(a, b, PRIORS, 0.03) is one
    assert are_one(b, a, PRIORS, 0.03) is one


def test_entries_that_are_one_are_among_those_that_may_be() -> None:
    known = [entry(k + 1, 0.007 * k) for k in range(60)]
    may = may_be_one(known, np.arange(60), PRIORS)
    one = np.array([[are_one(a, b, PRIORS, 0.03) for b in known] for a in known])
    assert (may | ~one).all()
    assert np.count_nonzero(one) > 60  # others than each with itself
    assert not may.all()


def test_observations_within_reach_of_a_box_are_compared() -> None:
    rng = np.random.default_rng(4)
    rows = np.column_stack([rng.uniform(0, 2, (40, 3)), rng.uniform(0.05, 1, (40, 3)), rng.uniform(-3, 3, 40)])
    voxels = VoxelSet.of_each([place + np.zeros((1, 3)) for place in rng.uniform(0, 2, (50, 3))], 0.03)
    seen = [Observation(c.points, 0, 0.5, image=VIEW if k % 2 else None) for k, c in enumerate(voxels)]
    found = in_reach(seen, voxels, rows, MapSettings())
    for k, each in enumerate(voxels):
        reach = 0.12 + (0.02 * float(np.linalg.norm(each.middle)) if k % 2 else 0.0)
        gaps = np.array([outside(each.middle, (row[:3], row[3:6], float(row[6]))) for row in rows])
        np.testing.assert_array_equal(found[k], gaps <= reach)
    assert 0 < np.count_nonzero(found) < found.size
