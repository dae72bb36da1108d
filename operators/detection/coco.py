"""The classes of COCO detection: the 80 in the order detectors number them, and by COCO's own numbers."""

from __future__ import annotations

from typing import Final

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
