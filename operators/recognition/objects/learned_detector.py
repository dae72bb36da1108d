"""Detection of known and of newly learned objects with one network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.custom.decode import find_boxes
from operators.detection.custom.first_look import FirstStageDetections
from operators.detection.custom.refiner import Refiner
from operators.detection.decode import Candidates
from operators.detection.nms import class_wise_nms, intersection_over_union
from operators.network_input import three_channels
from operators.recognition.objects.learned_object import LEAST, PROPOSALS, LearnedObject, LearnedObjectError
from operators.recognition.objects.proposals import F32, NetworkMaps, Trunk
from operators.scene.map.file import learned_files, together
from operators.weights import open_network, shipped, trained_in_simulation

_MAYBE, _STEPS = 0.003, 2  # probability from which a box is drawn to the outline, and how often that is repeated


class LearnedDetector(Operator):
    """Finds what CustomDetector finds, and objects that were learned from a few images by `dataflow learn object`.

    The network's weakest boxes, whatever class it gives them, propose places; the vectors of its trunk there are set
    against each learned prototype. Where a learned object is surer than a known class at the same place, it takes it;
    all other boxes stay as they are. One run of the network serves both, on one CPU thread.

    Methods: Snell et al., "Prototypical networks for few-shot learning", 2017, on the features of a trained detector;
    outlines by linear regression as in Girshick et al., "Rich feature hierarchies for accurate object detection", 2014.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Out[Detections2D] = Out(doc="boxes in the image's own pixels, by falling score; learned classes last")

    objects: list[str] = Param(
        doc="files of `dataflow learn object`, made with these weights, or saved maps that hold them"
    )
    weights: str | None = Param(None, doc="network file of `dataflow train detector`; none means the shipped one")
    score_threshold: float = Param(0.3, ge=0, le=1, tunable=True, doc="boxes of known classes below are dropped")
    learned_threshold: float = Param(0.3, ge=0, le=1, tunable=True, doc="and those of learned ones")
    nms_iou: float = Param(
        0.5, ge=0, le=1, tunable=True, doc="overlap above which the weaker box of a class is dropped"
    )
    max_detections: int = Param(100, ge=1, tunable=True, doc="keep the best so many")

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        return trained_in_simulation(params["weights"] or shipped("detector.onnx"))

    def setup(self) -> None:
        """Loads network and objects. Raises FileNotFoundError, NetworkFileError or LearnedObjectError."""
        given = str(shipped("detector.onnx")) if self.weights is None else self.weights
        file = self.use_file(given)
        learned = together(*(learned_files(Path(self.use_file(name))) for name in self.objects))
        if not learned:
            raise LearnedObjectError(
                "objects names no file of `dataflow learn object NAME DATA` and no map that was saved with one"
            )
        self._learned = [LearnedObject.of(each.content, each.name) for each in learned]
        inner = self._learned[0].inner
        for name, each in zip((each.name for each in learned), self._learned, strict=True):
            if each.detector != self.files[given] or each.inner != inner:
                raise LearnedObjectError(f"{name} was learned with another detector than {given}: learn it again")
        self._refiner = Refiner.within(open_network(file, "detector"))
        self._trunk = Trunk(file, inner, () if self._refiner is None else self._refiner.maps)
        self._names = tuple(dict.fromkeys((*self._trunk.classes, *(each.name for each in self._learned))))
        self._counts = {"images": 0, "learned objects": 0, "known boxes replaced": 0}

    def process(self, image: Image) -> Detections2D:
        pixels = three_channels(image.data)
        glance = self._trunk.look(pixels)
        known, learned = self._known(glance, pixels), self._found(glance)
        known = known.select(self._staying(known, learned))
        boxes = np.concatenate([known.boxes, learned.boxes])
        scores = np.concatenate([np.minimum(known.scores, np.float32(1)), learned.scores])
        classes = np.concatenate([known.classes, learned.classes])
        order = np.argsort(-scores, kind="stable")[: self.max_detections]
        self._counts["images"] += 1
        self._counts["learned objects"] += len(learned.scores)
        return Detections2D(
            width=image.width,
            height=image.height,
            class_names=self._names,
            boxes=boxes[order],
            scores=scores[order],
            class_ids=classes[order],
        )

    def summary(self) -> Mapping[str, float | int]:
        """Counts images, learned objects found, and boxes of known classes that gave way to them."""
        return dict(self._counts)

    def _known(self, glance: NetworkMaps, pixels: NDArray[np.uint8]) -> Candidates:
        """Returns the objects of known classes in an image, in its pixels, as CustomDetector finds them."""
        trunk, refiner = self._trunk, self._refiner
        found = find_boxes(
            glance.maps,
            trunk.anchors,
            trunk.strides,
            len(trunk.classes),
            self.score_threshold,
            self.nms_iou,
            self.max_detections,
        )
        found = replace(found, boxes=glance.fit.restore(found.boxes))
        if refiner is None:
            return found
        return refiner.refined(pixels, FirstStageDetections(found, glance.more, glance.fit), self.nms_iou)

    def _found(self, glance: NetworkMaps) -> Candidates:
        """Returns the learned objects in an image, in its pixels: for each class the surest of boxes that overlap."""
        proposed = self._trunk.propose(glance, LEAST, PROPOSALS)
        described = self._trunk.describe(glance, proposed)
        boxes, scores, classes = [proposed[:0]], [np.zeros(0, np.float32)], [np.zeros(0, np.int32)]
        for each in self._learned:
            drawn, sure = self._drawn(glance, each, proposed, described)
            rows = np.flatnonzero(sure >= self.learned_threshold)
            kept = rows[class_wise_nms(drawn[rows], sure[rows], np.zeros(len(rows), np.int32), 0.3)]
            boxes.append(np.array([_settled(drawn[k], drawn, sure) for k in kept], np.float32).reshape(-1, 4))
            scores.append(sure[kept])
            classes.append(np.full(len(kept), self._names.index(each.name), np.int32))
        restored = glance.fit.restore(np.concatenate(boxes))
        return Candidates(restored, np.concatenate(scores), np.concatenate(classes))

    def _drawn(self, glance: NetworkMaps, each: LearnedObject, boxes: F32, described: F32) -> tuple[F32, F32]:
        """Moves the boxes that may show a learned object to its outline; returns them with their probabilities."""
        rows = np.flatnonzero(each.probability(described) >= _MAYBE)
        boxes, described = boxes[rows], described[rows]
        for _ in range(_STEPS):
            boxes = each.drawn(boxes, described)
            described = self._trunk.describe(glance, boxes)
        return boxes, each.probability(described)

    def _staying(self, known: Candidates, learned: Candidates) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Returns the boxes of known classes at whose place no learned object is surer."""
        stays = np.ones(len(known.scores), bool)
        for box, score in zip(learned.boxes, learned.scores, strict=True):
            stays &= (intersection_over_union(box, known.boxes) < 0.5) | (known.scores > score)
        self._counts["known boxes replaced"] += int((~stays).sum())
        return np.flatnonzero(stays)


def _settled(box: F32, proposed: F32, sure: F32) -> F32:
    """Returns the mean of the boxes at one place, weighted by how surely they show the object: a steadier outline."""
    near = intersection_over_union(box, proposed) >= 0.6
    weights = (sure * near).astype(np.float64)
    return np.asarray(weights @ proposed / weights.sum(), np.float32)
