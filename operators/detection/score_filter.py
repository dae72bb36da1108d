"""The sure ones among detections."""

from __future__ import annotations

import numpy as np

from dataflow.messages import Detections2D
from dataflow.operator import In, Operator, Out, Param


class ScoreFilter(Operator):
    """Passes on the detections that are sure enough to act on.

    Scoring a detector asks for its unsure detections too (AP is over the whole curve), a robot for the sure ones: so
    let the detector keep a low threshold, and put this behind it.
    """

    detections: In[Detections2D] = In(doc="what a detector found")
    sure: Out[Detections2D] = Out(doc="those of at least `min_score`, in the same order; one message for each")

    stateless = True
    min_score: float = Param(0.4, ge=0, le=1, live=True, doc="detections below are left out")

    def process(self, detections: Detections2D) -> Detections2D:
        kept = detections.scores >= np.float32(self.min_score)
        rows = {
            name: value[kept]
            for name, value in detections.items()
            if isinstance(value, np.ndarray)  # every array of the message has a row for each box
        }
        return detections.replace(**rows)
