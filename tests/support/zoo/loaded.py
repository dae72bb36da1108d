"""A module that draws while it is loaded, and an operator that uses what it drew."""

from __future__ import annotations

import random

from dataflow.messages import FeatureVector
from zoo.operators import Hard

OFFSET = random.random()


class Loaded(Hard):
    """Adds what its module drew while it was loaded."""

    def work(self, x: FeatureVector) -> float:
        return OFFSET
