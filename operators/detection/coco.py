"""The classes of COCO detection: the 80 in the order detectors number them, and by COCO's own numbers."""

from __future__ import annotations

from typing import Final

from operators.inference import ModelError
from operators.models.registry import Model

_NAMES = """
    person, bicycle, car, motorcycle, airplane, bus, train, truck,
    boat, traffic light, fire hydrant, stop sign, parking meter, bench, bird, cat,
    dog, horse, sheep, cow, elephant, bear, zebra, giraffe,
    backpack, umbrella, handbag, tie, suitcase, frisbee, skis, snowboard,
    sports ball, kite, baseball bat, baseball glove, skateboard, surfboard, tennis racket, bottle,
    wine glass, cup, fork, knife, spoon, bowl, banana, apple,
    sandwich, orange, broccoli, carrot, hot dog, pizza, donut, cake,
    chair, couch, potted plant, bed, dining table, toilet, tv, laptop,
    mouse, remote, keyboard, cell phone, microwave, oven, toaster, sink,
    refrigerator, book, clock, vase, scissors, teddy bear, hair drier, toothbrush
"""

COCO_CLASSES: Final = tuple(name.strip() for name in _NAMES.split(","))

_UNUSED = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""Numbers up to 90 that COCO gives no class, as in its category ids."""

_USED = iter(COCO_CLASSES)
COCO_NUMBERS: Final = tuple("" if k in _UNUSED else next(_USED) for k in range(91))
"""Class names by COCO's own numbers from 0 to 90, which skip some; these have no name."""

CLASS_LISTS: Final = {"coco": COCO_CLASSES, "coco91": COCO_NUMBERS, "coco90": COCO_NUMBERS[1:]}
"""Lists of class names by their names in the registry of models."""


def names_of(model: Model | None) -> tuple[str, ...] | None:
    """Returns the class names of a row of the registry; None where it has none, or there is no row.

    Raises ModelError for the name of a list that there is not.
    """
    if model is None or model.classes is None:
        return None
    if isinstance(model.classes, list):
        return tuple(model.classes)
    if model.classes not in CLASS_LISTS:
        raise ModelError(f"{model.name}: there is no list of classes {model.classes!r}; {', '.join(CLASS_LISTS)}")
    return CLASS_LISTS[model.classes]
