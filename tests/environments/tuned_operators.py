"""An operator of a live run on a clock turned by hand, which needs a package of its environment."""

from __future__ import annotations

import os

import held_runs
import numpy as np

from dataflow.messages import FeatureVector
from dataflow.operator import Param


class Tuned(held_runs.Odometry):
    """Multiplies its steps by the number of `tiny`. A message at `fails_at` ms ends it, or its process (`dies`)."""

    fails_at: int = Param(-1, doc="ms")
    dies: bool = Param(False, doc="ends the process instead")

    def setup(self) -> None:
        import tiny

        self.gain = tiny.GAIN

    def process(self, step: FeatureVector, turn: FeatureVector) -> FeatureVector:
        if step.stamp == held_runs.STAMP + self.fails_at * held_runs.MS:
            if self.dies:
                os._exit(7)
            raise ValueError("not this one")
        return super().process(step.replace(vectors=step.vectors * np.float32(self.gain)), turn)
