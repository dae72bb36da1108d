"""Object detection with a network in an ONNX file."""

from __future__ import annotations

from typing import Literal

import numpy as np

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.coco import COCO_CLASSES
from operators.detection.decode import LAYOUTS, Candidates, DecoderName, Outputs
from operators.detection.nms import class_wise_nms
from operators.image.letterbox import Fit, FitMode
from operators.inference import ModelError, Provider, open_session
from operators.network_input import image_input, read_labels, three_channels


class OnnxDetector(Operator):
    """Finds objects in an image with an ONNX model; on the CPU with one thread, so equal images give equal boxes.

    The model takes one (1, 3, H, W) float32 input; the decoder defines its colours, range and fit, and the meaning of
    the output.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Out[Detections2D] = Out(doc="boxes in the image's own pixels, by falling score")

    model: str = Param(doc="ONNX file")
    decoder: DecoderName = Param(doc="family of the network: how its input is made and its output read")
    classes: str | None = Param(None, doc="text file with one class name a line; none means the 80 of COCO")
    score_threshold: float = Param(0.3, ge=0, le=1, live=True, doc="boxes below are dropped")
    nms_iou: float = Param(0.45, ge=0, le=1, live=True, doc="overlap above which the weaker box of a class is dropped")
    max_detections: int = Param(100, ge=1, live=True, doc="keep the best so many")
    fit: Literal["default", "stretch", "letterbox"] = Param(
        "default", doc="how the image fills the input; by default as the decoder's family was trained"
    )
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    input_size: int = Param(640, ge=32, doc="side of the input where the model leaves it open", unit="px")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError or ModelError."""
        file = self.use_file(self.model)
        self._session = open_session(file, self.provider)
        self._layout = LAYOUTS[self.decoder]
        self._input = image_input(
            file,
            self._session,
            (self.input_size, self.input_size),
            bgr=self._layout.bgr,
            mean=(self._layout.mean,) * 3,
            scale=(self._layout.scale,) * 3,
            layouts=("nchw",),
            types=("tensor(float)",),
        )
        self._fit: FitMode = self._layout.fit if self.fit == "default" else self.fit
        self._names = COCO_CLASSES if self.classes is None else read_labels(self.use_file(self.classes)).names

    def process(self, image: Image) -> Detections2D:
        """Raises ModelError where the model's output is not what the decoder reads, or has other classes than names."""
        fit = Fit.plan(self._fit, (image.width, image.height), self._input.size)
        tensor = self._input.tensor(fit.apply(three_channels(image.data)))
        outputs = self._session.run(None, {self._input.name: tensor})
        try:
            found = self._layout.decode(outputs, self._input.size, self.score_threshold)
        except ValueError as error:
            raise ModelError(f"OnnxDetector.decoder={self.decoder!r} does not fit {self.model}: {error}") from None
        self._check_classes(outputs, found)
        found = found.select(class_wise_nms(found.boxes, found.scores, found.classes, self.nms_iou))
        boxes = fit.restore(found.boxes[: self.max_detections])
        return Detections2D(
            stamp=image.stamp,
            frame=image.frame,
            width=image.width,
            height=image.height,
            class_names=self._names,
            boxes=boxes,
            scores=np.minimum(found.scores[: self.max_detections], np.float32(1)),
            class_ids=found.classes[: self.max_detections],
        )

    def _check_classes(self, outputs: Outputs, found: Candidates) -> None:
        known = self._layout.classes
        count = int(found.classes.max(initial=-1)) + 1 if known is None else known(outputs)
        if count > len(self._names) or (known is not None and count != len(self._names)):
            raise ModelError(
                f"{self.model} separates {count} {'classes' if known is not None else 'or more classes'}, but there "
                f"are {len(self._names)} class names{' (those of COCO)' if self.classes is None else ''}; give the "
                f"model's own in OnnxDetector.classes, one a line"
            )
