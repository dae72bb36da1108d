"""Operators for the type checker, which has to find each mistake that a line below ignores: else mypy reports the line,
since the project's configuration warns of ignores without use."""

from __future__ import annotations

from typing import TypedDict

import numpy as np

from dataflow.messages import Image, Number, Point
from dataflow.operator import In, Operator, Out


class Darkest(Operator):
    """Returns one message."""

    image: In[Image]
    darkest: Out[Number]

    def process(self, image: Image) -> Number | None:
        if image.data.size > 1:
            return Number(value=float(image.data.min()))
        if image.data.size == 1:
            return Point(position=np.zeros(3))  # type: ignore[return-value]
        return Number(value="dark")  # type: ignore[arg-type]


class Found(TypedDict, total=False):
    """Messages of `Finder`, by port."""

    place: Point | None
    score: Number


class Finder(Operator):
    """Returns a mapping."""

    image: In[Image]
    place: Out[Point]
    score: Out[Number]

    def process(self, image: Image) -> Found:
        place = Point(position=np.zeros(3))
        if image.data.size > 2:
            return {"place": place, "score": Number(value=1.0)}
        if image.data.size == 2:
            return {"place": place, "score": place}  # type: ignore[typeddict-item]
        if image.data.size == 1:
            return {"palce": place}  # type: ignore[typeddict-unknown-key]
        return {"place": None}


class Silent(Operator):
    """Returns a number in place of a message."""

    image: In[Image]
    score: Out[Number]

    def process(self, image: Image) -> float:  # type: ignore[override]
        return 0.0
