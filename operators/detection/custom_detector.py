"""Detection of a robot's own objects with a network trained by `dataflow train detector`."""

from __future__ import annotations

import numpy as np

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.custom.decode import find_boxes
from operators.detection.fit import Fit
from operators.weights import NetworkFileError, open_network, shipped


class CustomDetector(Operator):
    """Finds objects with a grid detector on one CPU thread, so equal images give equal boxes.

    The file tells classes, input size and anchors. Without one, the network that comes with the project is used; it
    knows the objects of the simulated worlds. To find your own objects: `dataflow train detector DATA`.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Out[Detections2D] = Out(doc="boxes in the image's own pixels, by falling score")

    weights: str | None = Param(
        None, doc="network file written by `dataflow train detector`; none means the shipped one"
    )
    score_threshold: float = Param(0.3, ge=0, le=1, live=True, doc="boxes below are dropped")
    nms_iou: float = Param(0.5, ge=0, le=1, live=True, doc="overlap above which a box of a class joins a stronger")
    max_detections: int = Param(100, ge=1, live=True, doc="keep the best so many")

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError or NetworkFileError."""
        file = self.use_file(self.weights if self.weights is not None else shipped("detector.onnx"))
        self._network = open_network(file, "detector")
        facts = self._network.facts
        self._anchors = np.array(facts.get("anchors", []), np.float32)
        self._strides = [int(s) for s in facts.get("strides", [])]
        if self._anchors.ndim != 3 or self._anchors.shape[::2] != (len(self._strides), 2) or not self._strides:
            raise NetworkFileError(
                f"{file}: its metadata must hold anchors (levels, anchors, 2) and a stride for each level, "
                f"has anchors {self._anchors.shape} and strides {self._strides}"
            )

    def process(self, image: Image) -> Detections2D:
        """Raises NetworkFileError where the network's output is not what its metadata say."""
        network = self._network
        pixels = image.data if image.is_color else np.repeat(image.data[..., None], 3, axis=2)
        fit = Fit.plan("letterbox", (image.width, image.height), network.size)
        try:
            found = find_boxes(
                network.run(fit.apply(pixels)),
                self._anchors,
                self._strides,
                len(network.classes),
                self.score_threshold,
                self.nms_iou,
                self.max_detections,
            )
        except ValueError as error:
            raise NetworkFileError(f"{network.file} does not fit its metadata: {error}") from None
        return Detections2D(
            stamp=image.stamp,
            frame=image.frame,
            width=image.width,
            height=image.height,
            class_names=network.classes,
            boxes=fit.restore(found.boxes),
            scores=np.minimum(found.scores, np.float32(1)),
            class_ids=found.classes,
        )
