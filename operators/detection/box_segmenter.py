"""Instance masks for the boxes of any detector, by a network that segments what it is shown."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, Image, pack_masks
from dataflow.operator import In, Operator, Out, Param
from operators.detection.instance_masks import inside
from operators.inference import ModelError, Provider, open_session
from operators.models.use import use_model
from operators.network_input import NORMALIZATIONS, image_input, three_channels

_CORNERS = (2.0, 3.0)  # labels of a box's upper left and lower right corner among a prompt's points


class BoxSegmenter(Operator):
    """Gives each detection the mask of what is in its box, with EfficientSAM; on the CPU with one thread, repeatable.

    The model takes an image (1, 3, H, W), points (1, Q, 2, 2) in its pixels and their labels (1, Q, 2), and answers
    with mask logits (1, Q, M, h, w) and how well it takes each of the M to fit (1, Q, M), of which the best is taken.
    Pixels outside a box are cut off. Masks that detections already have are replaced.

    Source: Xiong et al., "EfficientSAM", 2023, whose export this is; after Kirillov et al., "Segment Anything", 2023.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: In[Detections2D] = In(doc="boxes in the image's pixels")
    masked: Out[Detections2D] = Out(doc="the same detections with masks")

    model: str = Param("efficient_sam_ti", min_length=1, doc="a name of `dataflow models list`, or an ONNX file")
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    input_size: tuple[int, int] = Param((640, 640), doc="(width, height) where the model leaves it open", unit="px")
    most: int = Param(32, ge=1, tunable=True, doc="only the surest so many get masks; the others' are empty")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError, or ModelError for one of other inputs or outputs."""
        file = use_model(self, self.model).file
        self._session = open_session(file, self.provider)
        mean, scale = NORMALIZATIONS["unit"]
        self._input = image_input(
            file, self._session, self.input_size, bgr=False, mean=mean, scale=scale, layouts=("nchw",), others=2
        )
        beside = self._session.get_inputs()[1:]
        shapes = [list(each.shape[2:]) for each in beside]
        if len(beside) != 2 or len(shapes[0]) != 2 or len(shapes[1]) != 1 or len(self._session.get_outputs()) < 2:
            described = ", ".join(f"{i.name} {i.type} {i.shape}" for i in beside)
            raise ModelError(
                f"{file} must take points [1, Q, P, 2] and labels [1, Q, P] besides the image and give masks and how "
                f"well they fit; it takes {described}"
            )
        self._points, self._labels = (each.name for each in beside)
        self._kind = np.float16 if beside[0].type == "tensor(float16)" else np.float32
        self._at_once = not isinstance(beside[0].shape[1], int)

    def process(self, image: Image, detections: Detections2D) -> Detections2D:
        """Raises ValueError for detections in an image of another size, ModelError for outputs of another shape."""
        if (detections.width, detections.height) != (image.width, image.height):
            raise ValueError(
                f"detections in an image of {detections.width}x{detections.height} pixels cannot be segmented in one "
                f"of {image.width}x{image.height}"
            )
        masks = np.zeros((detections.count, image.height, image.width), np.bool_)
        rows = np.argsort(-detections.scores, kind="stable")[: self.most]
        if len(rows):
            size = np.array(self._input.size, np.float32)
            scale = size / np.array([image.width, image.height], np.float32)
            prompts = (detections.boxes[rows].reshape(-1, 2, 2) * scale).astype(np.float32)
            fitted = cv2.resize(three_channels(image.data), self._input.size, interpolation=cv2.INTER_LINEAR)
            tensor = self._input.tensor(np.asarray(fitted, np.uint8))
            groups = [prompts] if self._at_once else list(prompts[:, None])
            planes = np.concatenate([self._best(tensor, group) for group in groups])
            for row, plane in zip(rows.tolist(), planes, strict=True):
                sure = cv2.resize(plane, (image.width, image.height), interpolation=cv2.INTER_LINEAR) > 0
                masks[row] = inside(sure, detections.boxes[row])
        return detections.replace(masks=pack_masks(masks))

    def _best(self, tensor: NDArray[Any], prompts: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the logits (Q, h, w) of the best mask of each prompt (Q, 2, 2)."""
        labels = np.tile(np.array(_CORNERS, np.float32), (1, len(prompts), 1))
        beside = {self._points: prompts[None].astype(self._kind), self._labels: labels.astype(self._kind)}
        given = {self._input.name: tensor, **beside}
        masks, fits = (np.asarray(answer, np.float32) for answer in self._session.run(None, given)[:2])
        if masks.ndim != 5 or masks.shape[:3] != (1, len(prompts), *fits.shape[2:]) or fits.ndim != 3:
            raise ModelError(
                f"{self.model} gave {masks.shape} and {fits.shape} for {len(prompts)} boxes; masks (1, Q, M, h, w) and "
                f"fits (1, Q, M) are needed"
            )
        best: NDArray[np.float32] = masks[0][np.arange(len(prompts)), fits[0].argmax(axis=1)]
        return best
