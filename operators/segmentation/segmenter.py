"""Semantic segmentation with a network trained by `dataflow train segmenter`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Image, SegmentationMap
from dataflow.operator import In, Operator, Out, Param
from operators.image.letterbox import ImageFit
from operators.network_input import three_channels
from operators.segmentation.borders import Borders, scored
from operators.segmentation.labelled import VOID, enlarged, labelled, least_of
from operators.segmentation.scores import best_classes, probability
from operators.weights import NetworkFileError, open_network, shipped, trained_in_simulation


class Segmenter(Operator):
    """Gives every pixel a class on one CPU thread, so equal images give equal maps.

    The network works on its own input size; its answer is enlarged to the image without inventing classes. Where the
    file has a second network (training adds one), the borders between classes are looked at once more, in the image's
    own pixels. Without a file, the network that comes with the project is used; it was trained on simulated worlds.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    segmentation: Out[SegmentationMap] = Out(doc="class of every pixel of the image")

    weights: str | None = Param(None, doc="network file of `dataflow train segmenter`; none means the shipped one")
    confidence_threshold: float = Param(0.0, ge=0, le=1, tunable=True, doc="pixels below become void (255)")
    class_thresholds: dict[str, float] = Param({}, doc="the same for single classes, by name")
    with_confidence: bool = Param(False, tunable=True, doc="also give the confidence of every pixel")

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        return trained_in_simulation(params["weights"] or shipped("segmenter.onnx"))

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError, NetworkFileError, or ModelError for unknown classes."""
        file = self.use_file(self.weights if self.weights is not None else shipped("segmenter.onnx"))
        self._network = open_network(file, "segmenter")
        self._scored, self._borders = scored(self._network), None
        outputs = self._network.session.get_outputs()
        if [output.name for output in outputs] != ["classes", "confidence"] and not self._scored:
            told = ", ".join(f"{output.name} {output.type}" for output in outputs)
            raise NetworkFileError(f"{file} must have the outputs classes and confidence, or 8-bit scores; has {told}")
        if self._scored:
            self._borders = Borders.within(self._network)
        if len(self._network.classes) > VOID:
            raise NetworkFileError(f"{file} has {len(self._network.classes)} classes; at most {VOID} are possible")
        self._least()

    def process(self, image: Image) -> SegmentationMap:
        network, pixels = self._network, three_channels(image.data)
        fit = ImageFit.plan("letterbox", (image.width, image.height), network.size)
        found = network.run(fit.apply(pixels))
        wanted = self.with_confidence or self.confidence_threshold > 0 or bool(self.class_thresholds)
        classes, confidence = self._answered(found, pixels, fit, wanted)
        return labelled(
            image,
            network.classes,
            classes,
            None if confidence is None else np.asarray(enlarged(confidence, fit, cv2.INTER_LINEAR), np.float32),
            least=self._least(),
            with_confidence=self.with_confidence,
        )

    def _least(self) -> NDArray[np.float32] | float:
        where = "Segmenter.class_thresholds"
        return least_of(self._network.classes, self.confidence_threshold, self.class_thresholds, where)

    def _answered(
        self, found: Sequence[NDArray[Any]], pixels: NDArray[np.uint8], fit: ImageFit, wanted: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32] | None]:
        """Classes (H, W) of the image's pixels and, where wanted, their probability in the network's input."""
        if not self._scored:
            classes, confidence = found
            own = classes[0].astype(np.uint8)
            return np.asarray(enlarged(own, fit, cv2.INTER_NEAREST), np.uint8), confidence[0] if wanted else None
        scores, step = found[0][0], float(self._network.facts["score_step"])
        sure = probability(scores, step) if wanted else None
        if self._borders is not None:
            return self._borders.classes(scores, step, pixels, fit), sure
        return np.asarray(enlarged(best_classes(scores), fit, cv2.INTER_NEAREST), np.uint8), sure
