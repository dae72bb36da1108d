"""Appearance of images and objects as vectors of length 1: for re-identification and for recognising places."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, FeatureVector, Image
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.inference import ModelError
from operators.recognition.crops import covering, letterboxed
from operators.recognition.subjects import Per, Subjects
from operators.weights import open_network

if TYPE_CHECKING:
    from torch import nn

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
_SIDE = 224

Describe = Callable[[NDArray[np.uint8]], NDArray[np.float32]]
"""Pixels (h, w, 3) → features (D,) before they are normalised."""


class FeatureExtractor(Operator):
    """Describes whole images, or each detected object with `per: object`, by one L2-normalised vector a row.

    The network is one of `dataflow train classifier` (`weights`: its last hidden layer, 256 wide) or, without that, a
    classification network of torchvision without its head (`model`: resnet50 gives 2048, mobilenet_v3_large 960). The
    scalar product of two vectors of the same model is their similarity, 1 for equal. Method: features of a trained
    classifier as descriptors, Sharif Razavian et al. 2014.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Sampled[Detections2D] = Sampled(required=False, doc="objects of the same image, for `per: object`")
    features: Out[FeatureVector] = Out(doc="a vector of length 1 for the image or for each object")

    weights: str | None = Param(None, doc="network file of `dataflow train classifier`")
    model: str = Param("resnet50", doc="without `weights`: a classification model of torchvision")
    checkpoint: str | None = Param(None, doc="your weights for `model`: a file of torch.save; none: its cache's")
    device: str = Param("cpu", doc="for `model`: cpu, cuda, cuda:1 or mps")
    per: Per = Param("image", doc="what a row is about: the image, or each detected object")

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError, NetworkFileError or ModelError."""
        self._subjects = Subjects(self.per)
        self._name, self._describe = self._trained() if self.weights is not None else self._torchvision()

    def process(self, image: Image, detections: Detections2D | None) -> FeatureVector:
        shown, ids = self._subjects.of(image, detections)
        rows = [_normalised(self._describe(view)) for view in shown]
        return FeatureVector(
            stamp=image.stamp,
            frame=image.frame,
            model=self._name,
            vectors=np.array(rows, np.float32) if rows else np.zeros((0, 0), np.float32),
            ids=ids,
        )

    def summary(self) -> Mapping[str, float | int | str]:
        """Counts the images without detections of the same stamp."""
        return self._subjects.summary()

    def _trained(self) -> tuple[str, Describe]:
        assert self.weights is not None
        network = open_network(self.use_file(self.weights), "classifier")
        digest = self.files[self.weights][:12]

        def describe(view: NDArray[np.uint8]) -> NDArray[np.float32]:
            return np.asarray(network.run(letterboxed(view, network.size))[1][0], np.float32)

        return f"classifier-{digest}", describe

    def _torchvision(self) -> tuple[str, Describe]:
        from operators.torch_models import DEFAULT, Runner, load

        file = None if self.checkpoint is None else self.use_file(self.checkpoint)
        loaded = load("classification", self.model, DEFAULT, file, self.device)
        run = Runner(_headless(loaded.model, self.model), loaded.device, half=False)

        def describe(view: NDArray[np.uint8]) -> NDArray[np.float32]:
            import torch

            scaled = (covering(view, _SIDE).astype(np.float32) / 255 - _MEAN) / _DEVIATION
            tensor = torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)[None]))
            found: NDArray[np.float32] = run(tensor, lambda model, x: model(x)[0].float().cpu().numpy())
            return found

        origin = "own" if self.checkpoint is not None else "imagenet"
        return f"torchvision-{self.model}-{origin}", describe


def _headless(model: nn.Module, name: str) -> nn.Module:
    """The model whose last layers are left out, so that it gives what they would classify."""
    from torch import nn

    for head in ("fc", "classifier", "heads", "head"):
        if isinstance(getattr(model, head, None), nn.Module):
            setattr(model, head, nn.Identity())
            return model
    raise ModelError(f"{name} has no head that can be left out (fc, classifier, heads or head): choose another model")


def _normalised(vector: NDArray[np.float32]) -> NDArray[np.float32]:
    """The vector with length 1; one of zeros, which has no direction, stays as it is."""
    length = float(np.linalg.norm(vector.astype(np.float64)))
    return vector if length == 0 else (vector / np.float32(length)).astype(np.float32)
