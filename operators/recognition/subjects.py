"""Chooses what an operator describes: whole images, or the objects of detections with the image's own stamp."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image
from operators.recognition.crops import views

Per = Literal["image", "object"]


class Subjects:
    """Gives the views of each image. `missed` counts the images without detections of the same stamp."""

    def __init__(self, per: Per) -> None:
        self.per = per
        self.missed = 0

    def of(
        self, image: Image, detections: Detections2D | None
    ) -> tuple[list[NDArray[np.uint8]], NDArray[np.int64] | None]:
        """Returns views (h, w, 3) and the ids of what they show; none where objects are asked for and not known."""
        if self.per == "image":
            return views(image, None)
        if detections is None or detections.stamp != image.stamp:
            self.missed += 1
            return [], np.zeros(0, np.int64)
        return views(image, detections)

    def summary(self) -> dict[str, int]:
        """Counts, for an operator's summary; empty where nothing is to be told."""
        return {"images_without_detections": self.missed} if self.missed else {}
