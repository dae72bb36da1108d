"""Detection of small things in the image's own resolution, where another detector saw some."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.decode import Candidates
from operators.detection.focus.model import FocusModel
from operators.detection.focus.regions import Region, pixels_of, regions
from operators.detection.nms import intersection_over_union
from operators.detection.some import by_score, indices, of_classes, require_same_image, small_ones
from operators.network_input import three_channels
from operators.weights import shipped

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

_LARGER = 1.2  # times `largest`, up to which a box is found anew
_MORE = 100  # boxes that are found anew at most, beyond those that there were
_SAME = 0.4  # overlap with a larger box of another detector, from which a box is of the same thing


class FocusDetector(Operator):
    """Looks once more at small things, in the image's own resolution, and says where each of them ends.

    A detector sees the whole image made smaller, where books in a row run into each other. Around its small boxes of
    some classes, parts of the image are searched anew, and what is found there takes the place of those boxes; all
    others stay. The shipped network knows mugs, balls, bottles, boxes, books and plants of the simulated worlds
    (`dataflow train focus`); it finds books better than the shipped detector, the others worse. After Najibi, Singh
    and Davis, "AutoFocus: efficient multi-scale inference", 2019.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: In[Detections2D] = In(doc="what a detector found in the image")
    refined: Out[Detections2D] = Out(doc="detections, by falling score, with the small ones found anew")

    weights: str | None = Param(None, doc="network file of `dataflow train focus`; none means the shipped one")
    score_threshold: float = Param(0.3, ge=0, le=1, live=True, doc="boxes found anew below are dropped")
    nms_iou: float = Param(0.5, ge=0, le=1, live=True, doc="overlap above which a box of a class joins a stronger")
    classes: tuple[str, ...] = Param(
        ("book",), doc="look at these alone, by name; none means all that the network knows"
    )
    width: int = Param(640, ge=1, unit="px", doc="images less wide are enlarged to it: the network learned from such")
    largest: float = Param(
        110.0, gt=0, unit="px", doc="detections whose longer side is above, in an image so enlarged, stay as they are"
    )
    most_pixels: int = Param(
        160_000, ge=0, unit="px", doc="so much of an image is looked at, the surest detections first; others stay"
    )

    def setup(self) -> None:
        """Opens the network. Raises FileNotFoundError, NetworkFileError, or ValueError for unknown classes."""
        file = self.use_file(str(shipped("focus.onnx")) if self.weights is None else self.weights)
        self._model = FocusModel.open(file)
        unknown = sorted(set(self.classes) - set(self._model.classes))
        if unknown:
            known = ", ".join(self._model.classes)
            raise ValueError(f"FocusDetector.classes: the network knows no {', '.join(unknown)}; it knows {known}")
        self._names = self.classes or self._model.classes
        self._counts: Counter[str] = Counter()

    def process(self, image: Image, detections: Detections2D) -> Detections2D:
        """Raises ValueError where the detections are of an image of another size."""
        pixels = three_channels(image.data)
        require_same_image(pixels, detections)
        scale = max(1.0, self.width / detections.width)
        small = small_ones(detections, self._names, self.largest / scale)
        size = (round(scale * detections.width), round(scale * detections.height))
        chosen, looked = self._chosen(scaled(detections.boxes, scale), detections.scores, small, size)
        self._counts.update({"images": 1, "regions": len(chosen), "looked at": int(looked.sum())})
        self._counts["beyond most_pixels"] += int((small & ~looked).sum())
        if not chosen:
            return detections
        if scale > 1:
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        found = self._model.found(pixels, chosen, self.score_threshold, self.nms_iou, detections.count + _MORE)
        return self._joined(detections, looked, replace(found, boxes=scaled(found.boxes, 1 / scale)), scale)

    def snapshot(self) -> Mapping[str, Any]:
        return dict(self._counts)

    def restore(self, state: Mapping[str, Any]) -> None:
        self._counts = Counter({key: int(n) for key, n in state.items()})

    def summary(self) -> Mapping[str, float | int]:
        """Counts images, regions, detections that were looked at, and those that were more than `most_pixels` allow."""
        return dict(self._counts)

    def _chosen(self, boxes: F32, scores: F32, small: Mask, size: tuple[int, int]) -> tuple[list[Region], Mask]:
        """Returns the regions to look at in an image of `size` and which of the small boxes (N, 4) they hold."""
        middles = (boxes[:, :2] + boxes[:, 2:]) / 2
        held = []
        for region in regions(boxes[small], size):
            x1, y1, x2, y2 = region
            rows = small & (middles >= (x1, y1)).all(axis=1) & (middles <= (x2, y2)).all(axis=1)
            held.append((float(scores[rows].max(initial=0.0)), region, rows))
        chosen, looked, left = [], np.zeros(len(boxes), bool), self.most_pixels
        for _, region, rows in sorted(held, key=lambda each: (-each[0], each[1])):
            if pixels_of(region) <= left:
                left -= pixels_of(region)
                chosen.append(region)
                looked |= rows
        return chosen, looked

    def _joined(self, detections: Detections2D, looked: Mask, found: Candidates, scale: float) -> Detections2D:
        """Returns detections with what was found in place of those that were looked at."""
        ids = indices(detections.class_names, self._model.classes)
        wanted = np.array([name in self._names for name in self._model.classes], bool) & (ids >= 0)
        extent = found.boxes[:, 2:] - found.boxes[:, :2]
        found = found.select(
            wanted[found.classes] & (scale * extent.max(axis=1, initial=0.0) <= _LARGER * self.largest)
        )
        others = ~looked & of_classes(detections, self._names)
        alone = np.ones(len(found.boxes), bool)
        for box in detections.boxes[others]:
            alone &= intersection_over_union(box, found.boxes) < _SAME
        found = found.select(alone)
        boxes = np.concatenate([detections.boxes[~looked], found.boxes])
        scores = np.concatenate([detections.scores[~looked], np.clip(found.scores, 0, 1)])
        classes = np.concatenate([detections.class_ids[~looked], ids[found.classes]])
        return by_score(detections, boxes, scores, classes)


def scaled(boxes: F32, scale: float) -> F32:
    """Returns boxes (N, 4) in an image made larger by a factor."""
    return boxes if scale == 1 else (boxes * np.float32(scale)).astype(np.float32)
