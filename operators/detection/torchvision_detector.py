"""Object detection with torchvision's networks by name, in the images of one camera or of several at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from dataflow.messages import Detections2D, Image
from dataflow.operator import In, Operator, Out, Param
from operators.cameras import Cameras, same_size
from operators.torch_models import DEFAULT, Runner, batch_of, load, wanted_classes

if TYPE_CHECKING:
    from torch import nn


class _Detection(Operator, abstract=True):
    """Holds what both operators share: the model, its parameters, and boxes of images of one size."""

    stateless = True

    model: str = Param("fasterrcnn_resnet50_fpn_v2", doc="a detection model of torchvision")
    weights: str = Param(DEFAULT, doc="torchvision's weights by name (COCO_V1), from its cache; nothing is downloaded")
    checkpoint: str | None = Param(None, doc="your weights in place of them: a file of torch.save")
    device: str = Param("cpu", doc="cpu, cuda, cuda:1 or mps")
    half: bool = Param(False, doc="compute in half precision; on a GPU alone")
    classes: tuple[str, ...] = Param((), doc="only these classes, by name; none means all")
    score_threshold: float = Param(0.5, ge=0, le=1, tunable=True, doc="boxes below are dropped")
    nms_iou: float | None = Param(
        None, ge=0, le=1, doc="overlap above which the weaker box of a class is dropped; none means the model's own"
    )
    max_detections: int = Param(100, ge=1, tunable=True, doc="keep the best so many of an image")

    def setup(self) -> None:
        """Loads the model. Raises FileNotFoundError, or ModelError for missing weights, devices or classes."""
        file = None if self.checkpoint is None else self.use_file(self.checkpoint)
        loaded = load("detection", self.model, self.weights, file, self.device)
        self._names = loaded.classes
        self._wanted = wanted_classes(self._names, self.classes, f"{type(self).__name__}.classes")
        self._run = Runner(loaded.model, loaded.device, half=self.half)
        _limit(loaded.model, self.score_threshold, self.nms_iou)

    def summary(self) -> Mapping[str, float | int | str]:
        """Counts the images for which the GPU's memory did not suffice."""
        return self._run.summary()

    def _found_in(self, images: Sequence[Image]) -> list[Detections2D]:
        """The detections of images of one size, by one call of the network."""
        answers = self._run(batch_of(images), lambda model, batch: model(list(batch)))
        return [self._detections(image, found) for image, found in zip(images, answers, strict=True)]

    def _detections(self, image: Image, found: Mapping[str, Any]) -> Detections2D:
        boxes, scores, labels = (found[key].float().cpu().numpy() for key in ("boxes", "scores", "labels"))
        labels = labels.astype(np.int32)
        keep = (scores >= self.score_threshold) & self._wanted[labels]
        keep &= (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])
        order = np.flatnonzero(keep)[np.argsort(-scores[keep], kind="stable")][: self.max_detections]
        return Detections2D(
            stamp=image.stamp,
            frame=image.frame,
            width=image.width,
            height=image.height,
            class_names=self._names,
            boxes=boxes[order].astype(np.float32),
            scores=np.clip(scores[order], 0, 1).astype(np.float32),
            class_ids=labels[order],
        )


class TorchvisionDetector(_Detection):
    """Finds objects with a network of torchvision's zoo: Faster R-CNN, SSD, RetinaNet, FCOS and others by name.

    Class names and ids come from the weights themselves. On a CPU with one thread equal images give equal boxes; on a
    GPU they do as far as the card's libraries do. Where the GPU's memory does not suffice, an image is worked on by the
    CPU, which is counted and logged once. Methods: Ren et al. 2015 (Faster R-CNN), Liu et al. 2016 (SSD), Lin et al.
    2017 (RetinaNet), as implemented by torchvision (BSD-3-Clause).
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Out[Detections2D] = Out(doc="boxes in the image's own pixels, by falling score")

    def process(self, image: Image) -> Detections2D:
        return self._found_in([image])[0]


class TorchvisionRigDetector(_Detection, merge=True):
    """Finds objects in the images of several cameras at once: one call of the network for all images of one stamp.

    Boxes are those that TorchvisionDetector finds camera by camera, to 1e-4 of a pixel. A camera without an image at a
    stamp is left out of that call, so one that fails holds up no other; cameras that take their images at different
    times (no common trigger) are served one by one. Images of different sizes go through the network by size, since
    borders around the smaller ones would change their boxes. For more than six cameras derive a class with more
    outputs.
    """

    images: In[Image] = In(many=True, doc="RGB or grey images of all cameras, told apart by their frames")
    detections_1: Out[Detections2D] = Out(doc="boxes in the first camera's pixels, by falling score")
    detections_2: Out[Detections2D] = Out(doc="in the second's")
    detections_3: Out[Detections2D] = Out(doc="in the third's")
    detections_4: Out[Detections2D] = Out(doc="in the fourth's")
    detections_5: Out[Detections2D] = Out(doc="in the fifth's")
    detections_6: Out[Detections2D] = Out(doc="in the sixth's")

    cameras: tuple[str, ...] = Param(min_length=1, doc="frames of the cameras' images, in the order of the outputs")

    def setup(self) -> None:
        """Loads the model. Raises ValueError for frames named twice, or more of them than there are outputs, too."""
        self._cameras = Cameras(self.cameras, list(self.spec.outputs), f"{type(self).__name__}.cameras")
        super().setup()

    def process(self, images: Mapping[str, Image]) -> dict[str, Detections2D]:
        """Raises ValueError for an image in a frame that is no camera's, or two in one frame."""
        found: dict[str, Detections2D] = {}
        for group in same_size(self._cameras.by_port(images.values())):
            found |= zip(group, self._found_in(list(group.values())), strict=True)
        return found


def _limit(model: nn.Module, score: float, nms_iou: float | None) -> None:
    """Makes a model give all boxes down to `score`, and sets the overlap of its suppression where one is given.

    torchvision keeps both on the model (SSD, RetinaNet, FCOS) or on its heads (the R-CNNs).
    """
    part = getattr(model, "roi_heads", model)
    part.score_thresh = min(float(part.score_thresh), score)  # type: ignore[arg-type]
    if nms_iou is not None:
        part.nms_thresh = nms_iou
