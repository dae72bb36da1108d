"""Instance masks for the boxes of any detector, by a network that segments what it is shown."""

from __future__ import annotations

import cv2
import numpy as np

from dataflow.messages import Detections2D, Image, pack_masks
from dataflow.operator import In, Operator, Out, Param
from operators.detection.instance_masks import inside
from operators.detection.prompted import EncoderAndDecoder, ImageAndBoxes
from operators.inference import Provider
from operators.models.use import use_model
from operators.network_input import three_channels


class BoxSegmenter(Operator):
    """Gives each detection the mask of what is in its box, with EfficientSAM, SAM or MobileSAM; on the CPU with one
    thread, repeatable.

    The model takes an image (1, 3, H, W), points (1, Q, 2, 2) in its pixels and their labels (1, Q, 2), and answers
    with mask logits (1, Q, M, h, w) and how well it takes each of the M to fit (1, Q, M), of which the best is taken.
    SAM and MobileSAM come in two files: `model` is the decoder as their `export_onnx_model.py` writes it, `encoder` the
    image's. Pixels outside a box are cut off. Masks that detections already have are replaced.

    Source: Xiong et al., "EfficientSAM", 2023, whose export this is; after Kirillov et al., "Segment Anything", 2023.
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: In[Detections2D] = In(doc="boxes in the image's pixels")
    masked: Out[Detections2D] = Out(doc="the same detections with masks")

    model: str = Param("efficient_sam_ti", min_length=1, doc="a name of `dataflow models list`, or an ONNX file")
    encoder: str = Param("", doc="the image encoder of a model that is a decoder by itself: a name or an ONNX file")
    provider: Provider = Param("cpu", doc="onnxruntime's execution provider; results repeat bit for bit on the CPU")
    input_size: tuple[int, int] = Param((640, 640), doc="(width, height) where the model leaves it open", unit="px")
    most: int = Param(32, ge=1, tunable=True, doc="only the surest so many get masks; the others' are empty")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError, or ModelError for one of other inputs or outputs."""
        file = use_model(self, self.model).file
        self._network: ImageAndBoxes | EncoderAndDecoder
        if self.encoder:
            self._network = EncoderAndDecoder(use_model(self, self.encoder).file, file, self.provider)
        else:
            self._network = ImageAndBoxes(file, self.provider, self.input_size)

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
            planes = self._network.logits(three_channels(image.data), detections.boxes[rows])
            for row, plane in zip(rows.tolist(), planes, strict=True):
                sure = cv2.resize(plane, (image.width, image.height), interpolation=cv2.INTER_LINEAR) > 0
                masks[row] = inside(sure, detections.boxes[row])
        return detections.replace(masks=pack_masks(masks))
