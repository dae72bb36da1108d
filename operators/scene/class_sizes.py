"""Usual sizes of the simulated world's classes: how deep an object is of which only one side was seen."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Usual:
    """Usual size: shorter and longer side on the ground and height, metres, and spreads of their logs.

    What is `round` has the outline of an ellipse, as seen from above. What is leafy shows points that are inside its
    box, by the share `inset` of half its side. What stands on the floor may have so much of its `foot`
    hidden, metres; 0 for what does not. What lies `along` the room does so always: it stands at a wall, in one or in a
    shelf.
    """

    size: tuple[float, float, float]
    spread: tuple[float, float, float]
    round: bool = False
    inset: float = 0.0
    foot: float = 0.0
    along: bool = False


CLASS_SIZES: dict[str, tuple[Usual, ...]] = {
    "person": (
        Usual((0.40, 0.57, 1.64), (0.35, 0.20, 0.10), True, foot=1.0),
        Usual((0.56, 0.70, 1.38), (0.15, 0.20, 0.10), True, foot=1.0),
    ),
    "chair": (Usual((0.47, 0.50, 0.96), (0.16, 0.13, 0.12), foot=0.2),),
    "table": (Usual((0.60, 1.50, 0.75), (0.40, 0.40, 0.16), foot=0.2),),
    "shelf": (Usual((0.31, 1.04, 1.43), (0.12, 0.20, 0.25), foot=0.2, along=True),),
    "door": (Usual((0.18, 1.06, 2.13), (0.50, 0.10, 0.05), foot=0.2, along=True),),
    "monitor": (Usual((0.20, 0.56, 0.48), (0.10, 0.12, 0.10)),),
    "plant": (
        Usual((0.11, 0.13, 0.23), (0.30, 0.30, 0.20), True, 0.4),
        Usual((0.40, 0.45, 0.86), (0.35, 0.35, 0.25), True, 0.4, foot=0.2),
    ),
    "box": (Usual((0.17, 0.20, 0.16), (0.45, 0.40, 0.42)),),
    "ball": (Usual((0.12, 0.12, 0.12), (0.45, 0.45, 0.45), True),),
    "mug": (Usual((0.08, 0.11, 0.10), (0.10, 0.10, 0.10), True),),
    "bottle": (Usual((0.07, 0.07, 0.25), (0.12, 0.12, 0.15), True),),
    "robot": (Usual((0.39, 0.41, 0.73), (0.10, 0.10, 0.10), foot=0.2),),
    "book": (
        Usual((0.035, 0.16, 0.23), (0.30, 0.12, 0.12), along=True),
        Usual((0.16, 0.22, 0.035), (0.12, 0.12, 0.30)),
    ),
    "lamp": (
        Usual((0.35, 0.35, 1.50), (0.15, 0.15, 0.12), True, foot=0.2),
        Usual((0.18, 0.18, 0.47), (0.15, 0.15, 0.15), True),
    ),
    "bin": (Usual((0.32, 0.32, 0.43), (0.15, 0.15, 0.18), True, foot=0.2),),
}
"""By class, each way in which such things stand: medians over the objects of 36 training worlds (seeds 10000 to 10011
of office, corridor and table_top). People who stand or walk come before those who sit, whose depth is less than it is
(0.86 m), since their legs are hidden and may be turned any way. Along the room, within two degrees, lie all of
55 doors, 120 shelves and 1104 books that stand (seeds 10000 to 10005); of other classes at most 7 in 10."""
