"""Detection of a robot's own objects with a network trained by `dataflow train detector`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.custom.refiner import GridFinder
from operators.detection.decode import detections_of
from operators.network_input import three_channels
from operators.weights import shipped, trained_in_simulation


class CustomDetector(Operator):
    """Finds objects with a grid detector on one CPU thread, so equal images give equal boxes.

    The file holds classes, input size and anchors. If it has a refiner (training adds one), the sides of each box are
    refined at the image's full resolution. Without a file, the network that comes with the project is used; it detects
    the objects of the simulated worlds only. To detect your own objects: `dataflow train detector DATA`.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Out[Detections2D] = Out(doc="boxes in the image's own pixels, by falling score")

    weights: str | None = Param(
        None, doc="network file written by `dataflow train detector`; none means the shipped one"
    )
    score_threshold: float = Param(0.3, ge=0, le=1, tunable=True, doc="boxes below are dropped")
    nms_iou: float = Param(0.5, ge=0, le=1, tunable=True, doc="overlap above which a box of a class joins a stronger")
    max_detections: int = Param(100, ge=1, tunable=True, doc="keep the best so many")

    @classmethod
    def trained_in_simulation(cls, params: Mapping[str, Any]) -> bool:
        return trained_in_simulation(params["weights"] or shipped("detector.onnx"))

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError or NetworkFileError."""
        self._finder = GridFinder(self.use_file(self.weights if self.weights is not None else shipped("detector.onnx")))

    def process(self, image: Image) -> Detections2D:
        """Raises NetworkFileError where the network's output is not what its metadata say."""
        pixels = three_channels(image.data)
        found = self._finder.find(pixels, self.score_threshold, self.nms_iou, self.max_detections)
        return detections_of(image, self._finder.names, found)
