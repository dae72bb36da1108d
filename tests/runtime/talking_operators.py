"""Operators that log, print and warn."""

from __future__ import annotations

import logging
import os
import sys
import time
import warnings

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Param


class Talker(Operator):
    """Says one thing in each way that there is; `every` says how often."""

    x: In[FeatureVector] = In(doc="when to speak")
    y: Out[FeatureVector] = Out(doc="the same")
    every: int = Param(10, ge=1, doc="firings between two words")
    wait: float = Param(0.0, ge=0, doc="seconds that a firing takes")

    def setup(self) -> None:
        self.count = 0
        self.log.info("ready to talk")

    def process(self, x: FeatureVector) -> FeatureVector:
        self.count += 1
        time.sleep(self.wait)
        if self.count % self.every == 0:
            self.log.debug("not shown unless asked for")
            self.log.warning("word %d", self.count // self.every)
            print("printed")
            print("to stderr", file=sys.stderr)
            logging.getLogger("some.library").error("two\nlines")
            warnings.warn("old function", stacklevel=1)
            os.write(1, b"from a library outside of Python\n")
        return x

    def close(self) -> None:
        print("good night", end="")
        sys.stdout.flush()
