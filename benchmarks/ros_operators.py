"""An operator between the two topics of `ros.py`."""

from __future__ import annotations

from dataflow.messages import Image, Text
from dataflow.operator import In, Operator, Out


class Passed(Operator):
    """Gives what it gets."""

    given: In[Text | Image] = In(doc="a message")
    passed: Out[Text | Image] = Out(doc="the same")

    def process(self, given: Text | Image) -> Text | Image:
        return given
