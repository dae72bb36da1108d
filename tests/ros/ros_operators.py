"""An operator between two topics."""

from __future__ import annotations

from dataflow.messages import Image
from dataflow.operator import In, Operator, Out


class Half(Operator):
    """Takes every second row and column."""

    image: In[Image] = In(doc="pixels")
    half: Out[Image] = Out(doc="a quarter of them")

    def process(self, image: Image) -> Image:
        return image.replace(data=image.data[::2, ::2])
