"""When two entries of the map are one thing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from operators.labels import LabelSpace, labels_file
from operators.scene.map.box_images import CORNERS
from operators.scene.map.cells import Cells
from operators.scene.map.cuboid import ImageView
from operators.scene.map.kinds import Kinds
from operators.scene.map.map_object import MapObject
from operators.scene.map.merging import are_one

SIZE = np.array([0.16, 0.04, 0.23])
NAMES = ("book", "mug")
KINDS = Kinds.of(LabelSpace.read(Path(labels_file("simulator"))), NAMES)
VIEW = ImageView(np.eye(3, 4), np.array([0.0, 0.0, 9.0, 9.0]), np.ones(4, np.bool_), np.zeros(3))


def entry(id: int, y: float, class_id: int = 0) -> MapObject:
    """An entry of a book that was seen in twenty views."""
    made = MapObject(id, Cells(0.03), np.eye(len(NAMES))[class_id], 3.0, 0, 0, views=20)
    made.center, made.size, made.images = np.array([2.0, y, 1.0]), SIZE.copy(), [VIEW]
    made.cells = Cells.of_each([CORNERS * SIZE + made.center], 0.03)[0]
    return made


@pytest.mark.parametrize(
    ("shared", "beside", "one"),
    [(0.1, 0, False), (0.2, 0, True), (0.2, 2, True), (0.2, 4, False), (0.4, 4, True), (0.4, 20, True)],
)
def test_entries_that_share_their_place_are_one_unless_views_show_them_beside_each_other(
    shared: float, beside: int, one: bool
) -> None:
    a, b = entry(1, 0.0), entry(2, 0.04 * (1 - shared))
    a.beside[2] = beside
    assert are_one(a, b, KINDS, 0.03) is one
    assert are_one(b, a, KINDS, 0.03) is one


@pytest.mark.parametrize(("shared", "beside", "one"), [(0.3, 0, False), (0.45, 0, True), (0.45, 4, False)])
def test_entries_of_two_classes_are_one_where_they_share_more(shared: float, beside: int, one: bool) -> None:
    a, b = entry(1, 0.0), entry(2, 0.04 * (1 - shared), 1)
    a.beside[2] = beside
    assert are_one(a, b, KINDS, 0.03) is one
