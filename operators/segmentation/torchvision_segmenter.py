"""Semantic segmentation with torchvision's networks by name, of the images of one camera or of several at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Image, SegmentationMap
from dataflow.operator import In, Operator, Out, Param
from operators.cameras import Cameras, same_size
from operators.inference import ModelError
from operators.segmentation.labelled import VOID, labelled, least_of
from operators.torch_models import DEFAULT, Runner, batch_of, load

if TYPE_CHECKING:
    from torch import Tensor, nn

_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class _Segmentation(Operator, abstract=True):
    """Holds what both operators share: the model, its parameters, and maps of images of one size."""

    stateless = True

    model: str = Param("lraspp_mobilenet_v3_large", doc="a segmentation model of torchvision")
    weights: str = Param(DEFAULT, doc="torchvision's weights by name, from its cache; nothing is downloaded")
    checkpoint: str | None = Param(None, doc="custom weights in place of them: a file of torch.save")
    device: str = Param("cpu", doc="cpu, cuda, cuda:1 or mps")
    half: bool = Param(False, doc="compute in half precision; on a GPU alone")
    side: int = Param(520, ge=0, doc="shorter side of what the network sees; 0 leaves the image as it is", unit="px")
    confidence_threshold: float = Param(0.0, ge=0, le=1, tunable=True, doc="pixels below become void (255)")
    class_thresholds: dict[str, float] = Param({}, doc="the same for single classes, by name")
    with_confidence: bool = Param(False, tunable=True, doc="also give the confidence of every pixel")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError, or ModelError for missing weights, devices or classes."""
        file = None if self.checkpoint is None else self.use_file(self.checkpoint)
        loaded = load("segmentation", self.model, self.weights, file, self.device)
        self._names = tuple("background" if name == "__background__" else name for name in loaded.classes)
        if len(self._names) > VOID:
            raise ModelError(f"{self.model} has {len(self._names)} classes; at most {VOID} are possible")
        self._least()
        self._run = Runner(loaded.model, loaded.device, half=self.half)

    def summary(self) -> Mapping[str, float | int | str]:
        """Counts the images for which the GPU's memory did not suffice."""
        return self._run.summary()

    def _least(self) -> NDArray[np.float32] | float:
        where = f"{type(self).__name__}.class_thresholds"
        return least_of(self._names, self.confidence_threshold, self.class_thresholds, where)

    def _maps(self, images: Sequence[Image]) -> list[SegmentationMap]:
        """The classes of images of one size, by one call of the network."""
        classes, confidence = self._run(batch_of(images), self._classified)
        return [
            labelled(
                image,
                self._names,
                classes[k].cpu().numpy().astype(np.uint8),
                confidence[k].cpu().numpy().astype(np.float32),
                least=self._least(),
                with_confidence=self.with_confidence,
            )
            for k, image in enumerate(images)
        ]

    def _classified(self, model: nn.Module, batch: Tensor) -> tuple[Tensor, Tensor]:
        """Class and probability, (N, H, W) each, of images (N, 3, H, W) in [0, 1]."""
        from torchvision.transforms import functional

        height, width = batch.shape[2:]
        seen = batch if self.side == 0 else functional.resize(batch, [self.side], antialias=True)
        seen = functional.normalize(seen, list(_MEAN), list(_DEVIATION))
        scores = model(seen)["out"].float()
        if scores.shape[2:] != (height, width):
            from torch.nn.functional import interpolate

            scores = interpolate(scores, size=(height, width), mode="bilinear", align_corners=False)
        confidence, classes = scores.softmax(dim=1).max(dim=1)
        return classes, confidence


class TorchvisionSegmenter(_Segmentation):
    """Gives every pixel a class with a network of torchvision's zoo: DeepLabV3, LR-ASPP or FCN by name.

    Class names come from the weights themselves. The image is brought to `side` (its shorter one), normalised as
    torchvision's weights were trained, and the scores are brought back to the image before the best class is taken. On
    a CPU with one thread equal images give equal maps. Where a GPU's memory does not suffice, the CPU does an image,
    which is counted and logged. Methods: Chen et al. 2017 (DeepLabV3), Howard et al. 2019 (LR-ASPP), Long et al. 2015
    (FCN).
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    segmentation: Out[SegmentationMap] = Out(doc="class of every pixel of the image")

    def process(self, image: Image) -> SegmentationMap:
        return self._maps([image])[0]


class TorchvisionRigSegmenter(_Segmentation, merge=True):
    """Gives every pixel a class in the images of several cameras at once: one call for all images of one stamp.

    Maps are those that TorchvisionSegmenter gives camera by camera, but for ties. A camera without an image at a stamp
    is left out of that call; images of different sizes go through the network by size. More than six cameras: a class
    derived from this one, with more outputs.
    """

    images: In[Image] = In(many=True, doc="RGB or grey images of all cameras, told apart by their frames")
    segmentation_1: Out[SegmentationMap] = Out(doc="class of every pixel of the first camera's image")
    segmentation_2: Out[SegmentationMap] = Out(doc="of the second's")
    segmentation_3: Out[SegmentationMap] = Out(doc="of the third's")
    segmentation_4: Out[SegmentationMap] = Out(doc="of the fourth's")
    segmentation_5: Out[SegmentationMap] = Out(doc="of the fifth's")
    segmentation_6: Out[SegmentationMap] = Out(doc="of the sixth's")

    cameras: tuple[str, ...] = Param(min_length=1, doc="frames of the cameras' images, in the order of the outputs")

    def setup(self) -> None:
        """Loads the model. Raises ValueError for frames named twice, or more of them than there are outputs, too."""
        self._cameras = Cameras(self.cameras, list(self.spec.outputs), f"{type(self).__name__}.cameras")
        super().setup()

    def process(self, images: Mapping[str, Image]) -> dict[str, SegmentationMap]:
        """Raises ValueError for an image in a frame that is no camera's, or two in one frame."""
        found: dict[str, SegmentationMap] = {}
        for group in same_size(self._cameras.by_port(images.values())):
            found |= zip(group, self._maps(list(group.values())), strict=True)
        return found
