"""Semantic segmentation with torchvision's networks by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from dataflow.messages import Image, SegmentationMap
from dataflow.operator import In, Operator, Out, Param
from operators.inference import ModelError
from operators.torch_models import DEFAULT, Runner, load, tensor_of

if TYPE_CHECKING:
    from torch import Tensor, nn

VOID = 255
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class TorchvisionSegmenter(Operator):
    """Gives every pixel a class with a network of torchvision's zoo: DeepLabV3, LR-ASPP or FCN by name.

    Class names come from the weights themselves. The image is brought to `side` (its shorter one), normalised as
    torchvision's weights were trained, and the scores are brought back to the image before the best class is taken. On
    a CPU with one thread equal images give equal maps. Where a GPU's memory does not suffice, the CPU does an image,
    which is counted and logged. Methods: Chen et al. 2017 (DeepLabV3), Howard et al. 2019 (LR-ASPP), Long et al. 2015
    (FCN).
    """

    stateless = True

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    segmentation: Out[SegmentationMap] = Out(doc="class of every pixel of the image")

    model: str = Param("lraspp_mobilenet_v3_large", doc="a segmentation model of torchvision")
    weights: str = Param(DEFAULT, doc="torchvision's weights by name, from its cache; nothing is downloaded")
    checkpoint: str | None = Param(None, doc="weights of your own in place of them: a file of torch.save")
    device: str = Param("cpu", doc="cpu, cuda, cuda:1 or mps")
    half: bool = Param(False, doc="compute in half precision; on a GPU alone")
    side: int = Param(520, ge=0, doc="shorter side of what the network sees; 0 leaves the image as it is", unit="px")
    confidence_threshold: float = Param(0.0, ge=0, le=1, live=True, doc="pixels below become void (255)")
    with_confidence: bool = Param(False, live=True, doc="also give the confidence of every pixel")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError, or ModelError for weights or a device that is not there."""
        file = None if self.checkpoint is None else self.use_file(self.checkpoint)
        loaded = load("segmentation", self.model, self.weights, file, self.device)
        self._names = tuple("background" if name == "__background__" else name for name in loaded.classes)
        if len(self._names) > VOID:
            raise ModelError(f"{self.model} has {len(self._names)} classes; at most {VOID} are possible")
        self._run = Runner(loaded.model, loaded.device, half=self.half)

    def process(self, image: Image) -> SegmentationMap:
        classes, confidence = self._run(tensor_of(image), self._classified)
        labels = classes.cpu().numpy().astype(np.uint8)
        sure = np.clip(confidence.cpu().numpy(), 0, 1).astype(np.float32)
        if self.confidence_threshold > 0:
            labels = np.where(sure < self.confidence_threshold, np.uint8(VOID), labels)
        return SegmentationMap(
            stamp=image.stamp,
            frame=image.frame,
            class_names=self._names,
            void=VOID,
            classes=labels,
            confidence=sure if self.with_confidence else None,
        )

    def summary(self) -> Mapping[str, float | int | str]:
        """Counts the images for which the GPU's memory did not suffice."""
        return self._run.summary()

    def _classified(self, model: nn.Module, tensor: Tensor) -> tuple[Tensor, Tensor]:
        """Class and probability, (H, W) each, of an image (3, H, W) in [0, 1]."""
        from torchvision.transforms import functional

        height, width = tensor.shape[1:]
        seen = tensor if self.side == 0 else functional.resize(tensor, [self.side], antialias=True)
        seen = functional.normalize(seen, list(_MEAN), list(_DEVIATION))
        scores = model(seen[None])["out"].float()
        if scores.shape[2:] != (height, width):
            from torch.nn.functional import interpolate

            scores = interpolate(scores, size=(height, width), mode="bilinear", align_corners=False)
        confidence, classes = scores.softmax(dim=1)[0].max(dim=0)
        return classes, confidence
