"""What stands on the floor behind something is not on what hides its foot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from operators.labels import LabelSpace, labels_file
from operators.scene.bodies import Body, BodyMemory
from operators.scene.relations import FLOOR, SURFACE, RelationRules, relations_of

TABLE, THING, TOP = 1, 2, SURFACE - 1


def relations(label: str, bottom: float, top: float, space: str = "coco") -> set[tuple[str, int]]:
    """Of a thing at the far edge of a table with its top at 0.74 m."""
    memory = BodyMemory(LabelSpace.read(Path(labels_file(space))))
    boxes = {
        FLOOR: ("floor", [0, 0, 0], [4, 4, 0]),
        TOP: ("tabletop", [0, 0, 0.73], [1.2, 1.4, 0.02]),
        TABLE: ("table", [0, 0, 0.37], [1.2, 1.4, 0.74]),
        THING: (label, [0.45, 0, (bottom + top) / 2], [0.2, 0.4, top - bottom]),
    }
    names, centers, sizes = zip(*boxes.values(), strict=True)
    bodies: list[Body] = memory.update(
        list(boxes), names, np.array(centers, float), np.array(sizes, float), np.zeros(len(boxes))
    )
    found = relations_of(bodies, None, RelationRules())
    return {(predicate, other) for (thing, predicate, other), score in found.items() if thing == THING and score >= 0.5}


@pytest.mark.parametrize(("bottom", "top"), [(0.67, 0.86), (0.76, 0.95), (0.5, 0.85)])
def test_the_back_of_a_chair_that_shows_behind_a_table_is_of_a_chair_on_the_floor(bottom: float, top: float) -> None:
    assert ("on", FLOOR) in relations("chair", bottom, top)
    assert not {("on", TABLE), ("on", TOP)} & relations("chair", bottom, top)


@pytest.mark.parametrize(
    ("label", "bottom", "top", "space"),
    [
        ("chair", 0.74, 1.64, "coco"),  # a whole chair on a table
        ("cup", 0.74, 0.84, "coco"),
        ("cup", 0.74, 0.77, "coco"),  # half hidden
        ("bottle", 0.73, 0.98, "coco"),
        ("book", 0.72, 0.76, "coco"),
        ("teddy bear", 0.74, 0.9, "coco"),  # of no usual size
        ("plant", 0.74, 0.97, "simulator"),  # of a kind that stands on tables
        ("plant", 0.74, 0.86, "simulator"),  # half of one
    ],
)
def test_object_on_a_table_keeps_its_carrier(label: str, bottom: float, top: float, space: str) -> None:
    assert {("on", TABLE), ("on", TOP)} <= relations(label, bottom, top, space)
    assert ("on", FLOOR) not in relations(label, bottom, top, space)
