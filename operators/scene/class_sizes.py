"""Usual sizes of the simulated world's classes: what tells how deep an object is of which only one side was seen."""

from __future__ import annotations

CLASS_SIZES: dict[str, tuple[float, float]] = {
    "person": (0.50, 0.59),
    "chair": (0.47, 0.50),
    "table": (0.71, 1.54),
    "shelf": (0.31, 1.04),
    "door": (0.18, 1.06),
    "monitor": (0.20, 0.56),
    "plant": (0.11, 0.13),
    "box": (0.17, 0.20),
    "ball": (0.12, 0.12),
    "mug": (0.08, 0.11),
    "bottle": (0.07, 0.07),
    "robot": (0.39, 0.41),
    "book": (0.04, 0.17),
    "lamp": (0.35, 0.35),
    "bin": (0.32, 0.32),
}
"""Shorter and longer side on the ground, metres: medians over the objects of 36 training worlds (seeds 10000 to 10011
of office, corridor and table_top)."""
