"""The classes of the simulated world: things that have identities, and the surfaces around them that do not."""

from __future__ import annotations

THINGS = (
    "person",
    "chair",
    "table",
    "shelf",
    "door",
    "monitor",
    "plant",
    "box",
    "ball",
    "mug",
    "bottle",
    "robot",
    "book",
    "lamp",
    "bin",
)
SURFACES = ("floor", "wall", "ceiling")
"""A picture, a window or a whiteboard counts as the wall it hangs on."""

CLASSES = THINGS + SURFACES
VOID = 255
"""The class id of a pixel that shows nothing."""

CLASS_IDS = {name: k for k, name in enumerate(CLASSES)}

ACTIVITIES = (
    "standing",
    "walking",
    "sitting_down",
    "sitting",
    "standing_up",
    "reaching",
    "drinking",
    "rolling",
    "driving",
    "resting",
)
"""The activities of movers.

Persons stand (upright, feet still), walk, sit down, sit, stand up (the two transitions), reach (a hand goes to an
object or puts it back) and drink (the held mug is away from the table). Balls roll or rest; robots drive, or rest
where they all but stand.
"""
ACTIVITY_IDS = {name: k for k, name in enumerate(ACTIVITIES)}
