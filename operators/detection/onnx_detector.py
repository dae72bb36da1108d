"""Object detection with a network in an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.detection.coco import COCO_CLASSES
from operators.detection.decode import LAYOUTS, Candidates, DecoderName
from operators.detection.fit import Fit, FitMode
from operators.detection.nms import class_wise_nms
from operators.inference import ModelError, Provider, open_session

if TYPE_CHECKING:
    import onnxruntime


class OnnxDetector(Operator):
    """Finds objects in an image with an ONNX model; on the CPU with one thread, so equal images give equal boxes.

    The model takes one (1, 3, H, W) float32 input; the decoder says what its colours, range, fit and output mean.
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
        self._input = self._session.get_inputs()[0].name
        self._size = _input_size(file, self._session, self.input_size)
        self._layout = LAYOUTS[self.decoder]
        self._fit: FitMode = self._layout.fit if self.fit == "default" else self.fit
        self._names = COCO_CLASSES if self.classes is None else _read_names(self.use_file(self.classes))

    def process(self, image: Image) -> Detections2D:
        """Raises ModelError where the model's output is not what the decoder reads."""
        fit = Fit.plan(self._fit, (image.width, image.height), self._size)
        outputs = self._session.run(None, {self._input: self._tensor(fit.apply(_three_channels(image.data)))})
        try:
            found = self._layout.decode(outputs, self._size, self.score_threshold)
        except ValueError as error:
            raise ModelError(f"OnnxDetector.decoder={self.decoder!r} does not fit {self.model}: {error}") from None
        self._check_classes(found)
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

    def _tensor(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The input (1, 3, H, W), in the decoder's range, of (H, W, 3) RGB pixels."""
        channels = pixels[..., ::-1] if self._layout.bgr else pixels
        tensor = np.ascontiguousarray(channels.transpose(2, 0, 1)[None], np.float32)
        if self._layout.mean:
            tensor -= np.float32(self._layout.mean)
        tensor /= np.float32(self._layout.scale)
        return tensor

    def _check_classes(self, found: Candidates) -> None:
        if found.classes.size and found.classes.max() >= len(self._names):
            raise ModelError(
                f"{self.model} found class {found.classes.max()}, but there are {len(self._names)} class names; "
                f"give the model's own in OnnxDetector.classes"
            )


def _input_size(file: Path, session: onnxruntime.InferenceSession, free: int) -> tuple[int, int]:
    """(width, height) of the input; `free` where the model leaves an extent open."""
    inputs = session.get_inputs()
    shape = inputs[0].shape
    if len(inputs) != 1 or len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
        described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
        raise ModelError(f"{file} must have one input tensor(float) [1, 3, H, W], has {described}")
    height, width = (extent if isinstance(extent, int) else free for extent in shape[2:])
    return width, height


def _read_names(file: Path) -> tuple[str, ...]:
    names = tuple(line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip())
    if not names:
        raise ModelError(f"{file} holds no class name; it should have one a line")
    return names


def _three_channels(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=2)
