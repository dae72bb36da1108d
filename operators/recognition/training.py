"""Training of the classifier, as a task for the training loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.augmentation import NONE, Variation, fitted, recolored, tensor_of, varied, warp
from operators.learning.balance import class_weights
from operators.learning.export import export_network
from operators.recognition.dataset import ClassificationData, LabelledImage
from operators.recognition.network import Architecture, ClassifierNetwork, DeployedClassifier

KIND = "classifier"
STEP = 32


class ClassifierTask:
    """Trains a ClassifierNetwork of input `size` (width, height; multiples of 32) on images sorted by class."""

    kind = KIND

    def __init__(
        self,
        data: ClassificationData,
        size: tuple[int, int] = (96, 96),
        *,
        seed: int = 0,
        variation: Variation | None = None,
        architecture: Architecture = "plain",
    ) -> None:
        if any(extent % STEP or extent <= 0 for extent in size):
            raise ValueError(f"the input's width and height must be multiples of {STEP}, got {size[0]}x{size[1]}")
        torch.manual_seed(seed)
        self.data, self.size = data, size
        self.architecture: Architecture = architecture
        self.variation = Variation() if variation is None else variation
        self.classifier = ClassifierNetwork(len(data.classes), architecture)
        labels = np.array([image.label for image in data.training], np.int64)
        self.class_weights = class_weights(labels, len(data.classes))

    @property
    def network(self) -> nn.Module:
        return self.classifier

    @property
    def samples(self) -> int:
        return len(self.data.training)

    def description(self) -> dict[str, Any]:
        return {
            "classes": list(self.data.classes),
            "size": list(self.size),
            "architecture": self.architecture,
            "images": self.samples,
        }

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor]:
        chosen = [self.data.training[k] for k in samples]
        images = np.stack([self._view(image, rng) for image, rng in zip(chosen, rngs, strict=True)])
        return torch.from_numpy(images), torch.tensor([image.label for image in chosen])

    def loss(self, batch: tuple[Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        images, labels = batch
        scores = self.classifier(images.to(device)).float()
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
        described = {
            "kind": KIND,
            "architecture": f"{self.architecture} cnn",
            "classes": list(self.data.classes),
            "width": self.size[0],
            "height": self.size[1],
            "training_images": self.samples,
            **facts,
        }
        assert isinstance(network, ClassifierNetwork)
        export_network(DeployedClassifier(network), self.size, ["probabilities", "features"], described, file)

    def _view(self, image: LabelledImage, rng: np.random.Generator | None) -> NDArray[np.float32]:
        """A random view of an image (3, H, W); as it is, fitted into the input, without `rng`."""
        pixels = image.read()
        affine = fitted((pixels.shape[1], pixels.shape[0]), self.size)
        if rng is None:
            return tensor_of(recolored(warp(pixels, affine, self.size), NONE, np.random.default_rng(0)))
        affine = varied(affine, self.size, self.variation, rng)
        return tensor_of(recolored(warp(pixels, affine, self.size), self.variation, rng))
