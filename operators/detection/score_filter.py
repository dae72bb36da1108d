"""The sure ones among detections."""

from __future__ import annotations

from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D
from dataflow.operator import In, Operator, Out, Param


class ScoreFilter(Operator):
    """Passes on the detections that are sure enough to act on.

    Scoring a detector asks for its unsure detections too (AP is over the whole curve), a robot for the sure ones: so
    let the detector keep a low threshold, and put this behind it. With `classes`, those of others are left out, too,
    whatever detector found them.
    """

    detections: In[Detections2D] = In(doc="what a detector found")
    sure: Out[Detections2D] = Out(doc="those of at least `min_score` and the `classes`, in order; a message for each")

    stateless = True
    min_score: float = Param(0.4, ge=0, le=1, tunable=True, doc="detections below are left out")

    classes: tuple[str, ...] = Param((), doc="only these classes, by name; none means all")

    def process(self, detections: Detections2D) -> Detections2D:
        """Raises ValueError for a class that the detector does not know."""
        kept = detections.scores >= np.float32(self.min_score)
        if self.classes:
            kept &= self._wanted(detections.class_names)[detections.class_ids]
        return detections.replace(
            **{name: value[kept] for name, value in detections.items() if isinstance(value, np.ndarray)}
        )

    def _wanted(self, names: tuple[str, ...]) -> NDArray[np.bool_]:
        """Returns the class ids (C,) that are asked for."""
        for name in self.classes:
            if name not in names:
                near = get_close_matches(name, names, 1)
                hint = f"did you mean {near[0]!r}? " if near else ""
                known = ", ".join(names) or "no names"
                raise ValueError(f"ScoreFilter.classes: the detector has no class {name!r}; {hint}it has {known}")
        return np.array([name in self.classes for name in names])
