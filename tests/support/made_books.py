"""A detector of one's own, which finds twelve books in a row in every image, with COCO's names."""

from __future__ import annotations

import numpy as np

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out
from operators.detection.coco import COCO_CLASSES

BOOKS = np.array([[60 + 16 * k, 80, 75 + 16 * k, 150] for k in range(12)], np.float32)


class BookDetector(Operator):
    """Gives the same books whatever the image shows."""

    image: In[Image] = In(doc="any image")
    detections: Out[Detections2D] = Out(doc="the books")

    def process(self, image: Image) -> Detections2D:
        return Detections2D(
            width=image.width, height=image.height, class_names=COCO_CLASSES, boxes=BOOKS, scores=np.full(12, 0.9),
            class_ids=np.full(12, COCO_CLASSES.index("book"), np.int32),
        )  # fmt: skip
