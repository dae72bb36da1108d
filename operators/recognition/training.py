"""Training of the classifier, as a task for the training loop."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.augmentation import NONE, Variation, fitted, recolored, tensor_of, varied, warp
from operators.learning.backbone import IMAGENET_MEAN, IMAGENET_STD
from operators.learning.balance import class_weights
from operators.learning.export import export_network
from operators.learning.image_task import ImageTask
from operators.recognition.dataset import ClassificationData, LabelledImage

Architecture = Literal["plain", "residual"]
FEATURES = 256
"""Width of the hidden layer, whose values describe an image."""
_CHANNELS = (32, 64, 128, 256)
_GRID = 2
"""Side of what the last block's map is averaged to: where in the image something lies still counts a little."""


class ClassifierNetwork(nn.Module):
    """Images (N, 3, H, W) in [0, 1], multiples of 32 → class scores (N, C) before the softmax."""

    def __init__(self, classes: int, architecture: Architecture = "plain") -> None:
        super().__init__()
        widths = (3, *_CHANNELS)
        block = _plain if architecture == "plain" else _Residual
        self.blocks = nn.Sequential(*(block(a, b) for a, b in pairwise(widths)))
        self.pool = nn.AdaptiveAvgPool2d(_GRID)
        self.hidden = nn.Linear(_CHANNELS[-1] * _GRID**2, FEATURES)
        self.drop = nn.Dropout(0.3)
        self.head = nn.Linear(FEATURES, classes)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def features(self, images: Tensor) -> Tensor:
        """Returns the hidden layer (N, 256) after its activation."""
        seen = (images - self.mean) / self.deviation  # type: ignore[operator]
        return torch.relu(self.hidden(self.pool(self.blocks(seen)).flatten(1)))

    def forward(self, images: Tensor) -> Tensor:
        scores: Tensor = self.head(self.drop(self.features(images)))
        return scores


class DeployedClassifier(nn.Module):
    """Images (1, 3, H, W) → probabilities (1, C) and features (1, 256): what the network file computes."""

    def __init__(self, network: ClassifierNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = self.network.features(images)
        return self.network.head(features).softmax(dim=1), features


def _plain(inputs: int, outputs: int) -> nn.Module:
    """Two 3x3 convolutions, each normalised and rectified; then half the resolution."""
    return nn.Sequential(*_convolution(inputs, outputs), *_convolution(outputs, outputs), nn.MaxPool2d(2))


class _Residual(nn.Module):
    """As a plain block, around which what comes in is carried (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        first, second = _convolution(inputs, outputs), _convolution(outputs, outputs)
        self.body = nn.Sequential(*first, *second[:-1])
        self.skip = nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs))
        self.pool = nn.MaxPool2d(2)

    def forward(self, x: Tensor) -> Tensor:
        pooled: Tensor = self.pool(torch.relu(self.body(x) + self.skip(x)))
        return pooled


def _convolution(inputs: int, outputs: int) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]


class ClassifierTask(ImageTask[ClassificationData]):
    """Trains a ClassifierNetwork of input `size` (width, height; multiples of 32) on images sorted by class."""

    kind, step = "classifier", 32

    def __init__(
        self,
        data: ClassificationData,
        size: tuple[int, int] = (96, 96),
        *,
        seed: int = 0,
        variation: Variation | None = None,
        architecture: Architecture = "plain",
    ) -> None:
        super().__init__(data, size, seed, variation)
        self.architecture: Architecture = architecture
        self.network: nn.Module = ClassifierNetwork(len(data.classes), architecture)
        labels = np.array([image.label for image in data.training], np.int64)
        self.class_weights = class_weights(labels, len(data.classes))

    def description(self) -> dict[str, Any]:
        return self._description(architecture=self.architecture)

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor]:
        chosen = [self.data.training[k] for k in samples]
        images = np.stack([self._view(image, rng) for image, rng in zip(chosen, rngs, strict=True)])
        return torch.from_numpy(images), torch.tensor([image.label for image in chosen])

    def loss(self, batch: tuple[Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        images, labels = batch
        scores = self.network(images.to(device)).float()
        weights = self.class_weights.to(device)
        return {"entropy": functional.cross_entropy(scores, labels.to(device), weights, label_smoothing=0.05)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        """Scores by the mean over classes of the share that is right; `accuracy` is over images."""
        device = next(network.parameters()).device
        right, count = np.zeros(len(self.data.classes)), np.zeros(len(self.data.classes))
        for image in self.data.validation:
            with torch.inference_mode():
                scores = network(torch.from_numpy(self._view(image, None))[None].to(device))
            count[image.label] += 1
            right[image.label] += int(scores.argmax()) == image.label
        there = count > 0
        score = float((right[there] / count[there]).mean()) if there.any() else 0.0
        return {"score": score, "accuracy": float(right.sum() / max(count.sum(), 1)), "mean_accuracy": score}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        assert isinstance(network, ClassifierNetwork)
        described = self._facts(f"{self.architecture} cnn", facts)
        export_network(DeployedClassifier(network), self.size, ["probabilities", "features"], described, file)

    def _view(self, image: LabelledImage, rng: np.random.Generator | None) -> NDArray[np.float32]:
        """A random view of an image (3, H, W); as it is, fitted into the input, without `rng`."""
        pixels = image.read()
        affine = fitted((pixels.shape[1], pixels.shape[0]), self.size)
        if rng is None:
            return tensor_of(recolored(warp(pixels, affine, self.size), NONE, np.random.default_rng(0)))
        affine = varied(affine, self.size, self.variation, rng)
        return tensor_of(recolored(warp(pixels, affine, self.size), self.variation, rng))
