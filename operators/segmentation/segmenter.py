"""Semantic segmentation with a network trained by `dataflow train segmenter`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Image, SegmentationMap
from dataflow.operator import In, Operator, Out, Param
from operators.detection.fit import Fit
from operators.network_input import three_channels
from operators.segmentation.labelled import VOID, enlarged, labelled, least_of
from operators.segmentation.scores import best_classes, probability
from operators.weights import NetworkFileError, open_network, shipped


class Segmenter(Operator):
    """Gives every pixel a class on one CPU thread, so equal images give equal maps.

    The network works on its own input size; its answer is enlarged to the image without inventing classes. Without a
    file, the network that comes with the project is used; it knows the simulated worlds.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    segmentation: Out[SegmentationMap] = Out(doc="class of every pixel of the image")

    weights: str | None = Param(None, doc="network file of `dataflow train segmenter`; none means the shipped one")
    confidence_threshold: float = Param(0.0, ge=0, le=1, live=True, doc="pixels below become void (255)")
    class_thresholds: dict[str, float] = Param({}, doc="the same for single classes, by name")
    with_confidence: bool = Param(False, live=True, doc="also give the confidence of every pixel")

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError, NetworkFileError, or ModelError for unknown classes."""
        file = self.use_file(self.weights if self.weights is not None else shipped("segmenter.onnx"))
        self._network = open_network(file, "segmenter")
        outputs = self._network.session.get_outputs()
        names = [output.name for output in outputs]
        self._scored = names == ["scores"] and outputs[0].type == "tensor(uint8)"
        if names != ["classes", "confidence"] and not self._scored:
            told = ", ".join(f"{output.name} {output.type}" for output in outputs)
            raise NetworkFileError(f"{file} must have the outputs classes and confidence, or 8-bit scores; has {told}")
        if len(self._network.classes) > VOID:
            raise NetworkFileError(f"{file} has {len(self._network.classes)} classes; at most {VOID} are possible")
        self._least()

    def process(self, image: Image) -> SegmentationMap:
        network = self._network
        fit = Fit.plan("letterbox", (image.width, image.height), network.size)
        wanted = self.with_confidence or self.confidence_threshold > 0 or bool(self.class_thresholds)
        classes, confidence = self._answered(network.run(fit.apply(three_channels(image.data))), wanted)
        return labelled(
            image,
            network.classes,
            np.asarray(enlarged(classes, fit, cv2.INTER_NEAREST), np.uint8),
            None if confidence is None else np.asarray(enlarged(confidence, fit, cv2.INTER_LINEAR), np.float32),
            least=self._least(),
            with_confidence=self.with_confidence,
        )

    def _least(self) -> NDArray[np.float32] | float:
        where = "Segmenter.class_thresholds"
        return least_of(self._network.classes, self.confidence_threshold, self.class_thresholds, where)

    def _answered(
        self, found: Sequence[NDArray[Any]], wanted: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:
        """Classes (H, W) and, where wanted, their probability (H, W), of what the network gave."""
        if self._scored:
            step = float(self._network.facts["score_step"])
            return best_classes(found[0][0]), probability(found[0][0], step) if wanted else None
        classes, confidence = found
        return classes[0].astype(np.uint8), confidence[0] if wanted else None
