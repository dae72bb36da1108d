"""Classes of images and objects, by a network trained by `dataflow train classifier`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from dataflow.messages import Classification, Detections2D, Image
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.recognition.crops import Per, Subjects, letterboxed
from operators.weights import NetworkFileError, open_network


class ImageClassifier(Operator):
    """Classifies a whole image, or, with `per: object`, each of the objects detected in it.

    On one CPU thread, so equal images give equal classes. Detections count when they have the image's own stamp; an
    image without any gets no rows, and is counted.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Sampled[Detections2D] = Sampled(required=False, doc="objects of the same image, for `per: object`")
    classes: Out[Classification] = Out(doc="likeliest class and all probabilities, a row an image or object")

    weights: str = Param(doc="network file of `dataflow train classifier`")
    per: Per = Param("image", doc="what a row is about: the image, or each detected object")
    threshold: float = Param(0.0, ge=0, le=1, tunable=True, doc="rows whose best probability is less are left out")

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError or NetworkFileError."""
        self._network = open_network(self.use_file(self.weights), "classifier")
        if [output.name for output in self._network.session.get_outputs()] != ["probabilities", "features"]:
            raise NetworkFileError(f"{self.weights} must have the outputs probabilities and features")
        self._subjects = Subjects(self.per)

    def process(self, image: Image, detections: Detections2D | None) -> Classification:
        shown, ids = self._subjects.of(image, detections)
        rows = [self._network.run(letterboxed(view, self._network.size))[0][0] for view in shown]
        names = self._network.classes
        probabilities = np.clip(np.array(rows, np.float32).reshape(-1, len(names)), 0, 1)
        keep = probabilities.max(axis=1, initial=0.0) >= self.threshold
        probabilities = probabilities[keep]
        return Classification(
            stamp=image.stamp,
            frame=image.frame,
            class_names=names,
            class_ids=probabilities.argmax(axis=1).astype(np.int32),
            scores=probabilities.max(axis=1, initial=0.0),
            probabilities=probabilities,
            ids=None if ids is None else ids[keep],
        )

    def summary(self) -> Mapping[str, float | int | str]:
        """Counts the images without detections of the same stamp."""
        return self._subjects.summary()
