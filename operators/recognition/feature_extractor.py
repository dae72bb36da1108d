"""Appearance of images and objects as vectors of length 1: for re-identification and for recognising places."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from dataflow.messages import Detections2D, FeatureVector, Image
from dataflow.operator import In, Operator, Out, Param, Sampled
from operators.inference import ModelError, Provider
from operators.language.image_tower import ImageTower, unit_rows
from operators.models.registry import Registry
from operators.models.use import names_a_model, use_model
from operators.recognition.crops import Per, Subjects, covering, letterboxed
from operators.weights import open_network

if TYPE_CHECKING:
    from torch import nn

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
_SIDE = 224

Describe = Callable[[list[NDArray[np.uint8]]], NDArray[np.float32]]
"""Pixels (h, w, 3) of N views, N above 0 → features (N, D), of any length."""


class FeatureExtractor(Operator):
    """Describes whole images, or each detected object with `per: object`, by one L2-normalised vector a row.

    The network is one of `dataflow train classifier` (`weights`: its last hidden layer, 256 wide) or, without that, an
    embedding of `dataflow models` or another ONNX file (`clip_vit_b32`, 512 wide, whose space text has too), or a
    classification network of torchvision without its head (resnet50 gives 2048, mobilenet_v3_large 960). The scalar
    product of two vectors of the same model is their similarity, 1 for equal. Methods: CLIP, Radford et al., "Learning
    transferable visual models from natural language supervision", 2021; features of a trained classifier as
    descriptors, Sharif Razavian et al. 2014.
    """

    image: In[Image] = In(doc="RGB, or grey, which is repeated in the three channels")
    detections: Sampled[Detections2D] = Sampled(required=False, doc="objects of the same image, for `per: object`")
    features: Out[FeatureVector] = Out(doc="a vector of length 1 for the image or for each object; 0 beyond `most`")

    weights: str | None = Param(None, doc="network file of `dataflow train classifier`")
    model: str = Param(
        "resnet50",
        min_length=1,
        doc="without `weights`: an embedding of `dataflow models list`, an ONNX file, or a classification model of "
        "torchvision",
    )
    normalization: Literal["none", "unit", "imagenet", "clip"] | None = Param(
        None, doc="of pixels for an ONNX file: its mean and scale by name; none takes the registry's, or CLIP's"
    )
    input_size: int | None = Param(
        None, ge=8, doc="side of an ONNX file's input where it is open; none takes the registry's, or 224", unit="px"
    )
    provider: Provider = Param(
        "cpu", doc="onnxruntime's execution provider for an ONNX file; results repeat bit for bit on the CPU"
    )
    checkpoint: str | None = Param(None, doc="your weights for torchvision's: a file of torch.save; none: its cache's")
    device: str = Param("cpu", doc="for torchvision's: cpu, cuda, cuda:1 or mps")
    per: Per = Param("image", doc="what a row is about: the image, or each detected object")
    most: int | None = Param(
        None, ge=1, tunable=True, doc="describe so many objects of an image, drawn anew for each; none means all"
    )

    def setup(self) -> None:
        """Loads the network. Raises FileNotFoundError, NetworkFileError or ModelError."""
        self._subjects = Subjects(self.per)
        if self.weights is not None:
            self._name, self._describe = self._trained(self.weights)
        elif names_a_model(self.model) and self.model not in Registry.load():
            self._name, self._describe = self._torchvision()
        else:
            self._name, self._describe = self._exported()

    def process(self, image: Image, detections: Detections2D | None) -> FeatureVector:
        shown, ids = self._subjects.of(image, detections)
        rows = np.arange(len(shown))
        if self.most is not None and len(shown) > self.most:
            rows = np.sort(self.rng.choice(len(shown), self.most, replace=False))
        found = unit_rows(self._describe([shown[k] for k in rows])) if len(rows) else np.zeros((0, 0), np.float32)
        vectors = np.zeros((len(shown), found.shape[1]), np.float32)
        vectors[rows] = found
        return FeatureVector(stamp=image.stamp, frame=image.frame, model=self._name, vectors=vectors, ids=ids)

    def summary(self) -> Mapping[str, float | int | str]:
        """Counts the images without detections of the same stamp."""
        return self._subjects.summary()

    def _trained(self, weights: str) -> tuple[str, Describe]:
        network = open_network(self.use_file(weights), "classifier")

        def describe(views: list[NDArray[np.uint8]]) -> NDArray[np.float32]:
            return np.array([network.run(letterboxed(view, network.size))[1][0] for view in views], np.float32)

        return f"classifier-{self.files[weights][:12]}", describe

    def _exported(self) -> tuple[str, Describe]:
        used = use_model(self, self.model)
        normalization = used.setting(self, "normalization", "clip")
        tower = ImageTower(used.file, normalization, used.setting(self, "input_size", _SIDE), self.provider)
        name = used.file.stem if used.model is None else used.model.name

        def describe(views: list[NDArray[np.uint8]]) -> NDArray[np.float32]:
            return tower([covering(view, tower.side) for view in views])

        return f"{name}-{self.files[self.model][:12]}", describe

    def _torchvision(self) -> tuple[str, Describe]:
        from operators.torch_models import DEFAULT, Runner, load

        file = None if self.checkpoint is None else self.use_file(self.checkpoint)
        loaded = load("classification", self.model, DEFAULT, file, self.device)
        run = Runner(_headless(loaded.model, self.model), loaded.device, half=False)

        def one(view: NDArray[np.uint8]) -> NDArray[np.float32]:
            import torch

            scaled = (covering(view, _SIDE).astype(np.float32) / 255 - _MEAN) / _DEVIATION
            tensor = torch.from_numpy(np.ascontiguousarray(scaled.transpose(2, 0, 1)[None]))
            found: NDArray[np.float32] = run(tensor, lambda model, x: model(x)[0].float().cpu().numpy())
            return found

        origin = "own" if self.checkpoint is not None else "imagenet"
        return f"torchvision-{self.model}-{origin}", lambda views: np.array([one(view) for view in views], np.float32)


def _headless(model: nn.Module, name: str) -> nn.Module:
    """The model whose last layers are left out, so that it gives what they would classify."""
    from torch import nn

    for head in ("fc", "classifier", "heads", "head"):
        if isinstance(getattr(model, head, None), nn.Module):
            setattr(model, head, nn.Identity())
            return model
    raise ModelError(f"{name} has no head that can be left out (fc, classifier, heads or head): choose another model")
