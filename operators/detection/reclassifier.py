"""Names of small detections by close-ups, in the image's own resolution."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.nms import intersection_over_union
from operators.detection.reclassify.model import ReclassifierModel
from operators.detection.some import indices, require_same_image, rows_of, small_ones
from operators.network_input import three_channels
from operators.weights import shipped

F32 = NDArray[np.float32]

_LEAST = 1e-12  # probability: a detector may know none of the classes that the close-up is like


class Reclassifier(Operator):
    """Says anew what the small things are that a detector found, by a close-up of each in the image's own resolution.

    Detectors see the whole image made smaller, where a ball looks like a mug. A small network looks at each small box
    of the classes that it knows; its probabilities times how much the detector's own class is to be believed give the
    class, and the score is that of the detector times its probability. All other detections stay as they are. With
    the shipped network: mugs, balls, bottles, boxes, books and plants of the simulated worlds (`dataflow train
    reclassifier`). After Cheng et al., "Revisiting RCNN: on awakening the classification power of Faster RCNN", 2018.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: In[Detections2D] = In(doc="what a detector found in the image")
    renamed: Out[Detections2D] = Out(doc="detections, by falling score, with the small ones named anew")

    weights: str | None = Param(None, doc="network file of `dataflow train reclassifier`; none means the shipped one")
    doubt: float = Param(0.05, gt=0, le=1, live=True, doc="how likely each other class is beside the detector's own")
    nms_iou: float = Param(0.5, ge=0, le=1, live=True, doc="overlap above which a renamed box joins a stronger one")
    largest: float = Param(115.0, gt=0, unit="px", doc="detections whose longer side is above stay as they are")

    def setup(self) -> None:
        """Opens the network. Raises FileNotFoundError or NetworkFileError."""
        file = self.use_file(str(shipped("reclassifier.onnx")) if self.weights is None else self.weights)
        self._model = ReclassifierModel.open(file)
        self._counts: Counter[str] = Counter()

    def process(self, image: Image, detections: Detections2D) -> Detections2D:
        """Raises ValueError where the detections are of an image of another size."""
        pixels = three_channels(image.data)
        require_same_image(pixels, detections)
        rows = small_ones(detections, self._model.classes, self.largest).nonzero()[0]
        self._counts.update({"images": 1, "looked at": len(rows)})
        if not len(rows):
            return detections
        ids = indices(detections.class_names, self._model.classes)
        before = detections.class_ids[rows]
        belief = np.where(ids == before[:, None], 1.0, self.doubt) * (ids >= 0)
        likely = np.maximum(self._model.judge(pixels, detections.boxes[rows]), _LEAST) * belief
        likely /= likely.sum(axis=1, keepdims=True)
        classes, scores = detections.class_ids.copy(), detections.scores.copy()
        classes[rows] = ids[likely.argmax(axis=1)]
        scores[rows] *= likely.max(axis=1).astype(np.float32)
        self._counts["renamed"] += int((classes[rows] != before).sum())
        kept = _without_renamed_doubles(detections, classes, scores, rows, self.nms_iou)
        order = np.argsort(-scores, kind="stable")
        return rows_of(detections.replace(class_ids=classes, scores=scores), order[kept[order]])

    def snapshot(self) -> Mapping[str, Any]:
        return dict(self._counts)

    def restore(self, state: Mapping[str, Any]) -> None:
        self._counts = Counter({key: int(n) for key, n in state.items()})

    def summary(self) -> Mapping[str, float | int]:
        """Counts images, detections that were looked at, and those that were given another class."""
        return dict(self._counts)


def _without_renamed_doubles(
    detections: Detections2D, classes: NDArray[np.int32], scores: F32, rows: NDArray[np.int64], nms_iou: float
) -> NDArray[np.bool_]:
    """Tells which detections (N,) stay: not those that now have the class of a surer one which they overlap."""
    kept = np.ones(detections.count, bool)
    order = rows[np.argsort(-scores[rows], kind="stable")]
    for k, row in enumerate(order):
        if not kept[row]:
            continue
        weaker = order[k + 1 :]
        now_alike = (classes[weaker] == classes[row]) & (detections.class_ids[weaker] != detections.class_ids[row])
        overlap = intersection_over_union(detections.boxes[row], detections.boxes[weaker])
        kept[weaker[now_alike & (overlap > nms_iou)]] = False
    return kept
