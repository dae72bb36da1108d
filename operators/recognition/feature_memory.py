"""Mean appearance of each object over the images that showed it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import FeatureVector
from dataflow.operator import Counts, In, Operator, Out, Param
from operators.language.image_tower import unit_rows


@dataclass(kw_only=True)
class State(Counts):
    """Holds the model of the vectors, and their sum by id, those seen last at the end."""

    model: str = ""
    sums: dict[int, NDArray[np.float64]] = field(default_factory=dict)


class FeatureMemory(Operator):
    """Gives the mean direction of the vectors of each object or node so far, when there is a new one of it.

    Objects are known by their ids; rows of zeros, of objects that were not described, do not count. Vectors of another
    model begin anew. A mean of several views describes a thing better than one of them does: Gu et al.,
    "ConceptGraphs", 2024.
    """

    features: In[FeatureVector] = In(doc="vectors with ids, as FeatureExtractor gives them with `per: object`")
    means: Out[FeatureVector] = Out(doc="unit vectors of the objects that were described now, by id")

    most: int = Param(5000, ge=1, doc="of more objects, those that were not described for longest are forgotten")
    state: State

    def process(self, features: FeatureVector) -> FeatureVector:
        """Raises ValueError for vectors without ids."""
        if features.ids is None:
            raise ValueError("features have no ids; FeatureExtractor gives them with per: object")
        if features.model != self.state.model:
            self.state.model, self.state.sums = features.model, {}
        sums, now = self.state.sums, []
        for id, vector in zip(features.ids.tolist(), features.vectors.astype(np.float64), strict=True):
            if vector.any():
                sums[id] = sums.pop(id, 0.0) + vector
                now.append(id)
        while len(sums) > self.most:
            del sums[next(iter(sums))]
        now = [id for id in dict.fromkeys(now) if id in sums]
        self.state.counts["vectors"] += len(now)
        vectors = unit_rows(np.stack([sums[id] for id in now])) if now else np.zeros((0, 0), np.float32)
        return features.replace(labels=(), vectors=vectors, ids=np.array(now, np.int64))
