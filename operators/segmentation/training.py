"""Training of the segmenter, as a task for the training loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.augmentation import Variation, tensor_of
from operators.learning.backbone import BACKBONES, load_backbone
from operators.learning.export import export_network
from operators.learning.image_task import ImageTask
from operators.learning.network_weights import begin_with, fitting_facts, sample_images
from operators.segmentation.dataset import VOID, SegmentationData
from operators.segmentation.network import WIDEST, DeployedSegmenter, ScoringSegmenter, SegmentationNetwork, enlarged
from operators.segmentation.score import confusion, mean_iou
from operators.segmentation.scores import MOST_CLASSES

_MEASURED = 4  # images


class SegmenterTask(ImageTask[SegmentationData]):
    """Trains a SegmentationNetwork of input `size` (width, height; multiples of 16) on images with masks."""

    kind, step = "segmenter", 16

    def __init__(
        self,
        data: SegmentationData,
        size: tuple[int, int] = (320, 240),
        *,
        seed: int = 0,
        width: float = 1.0,
        variation: Variation | None = None,
        architecture: str = "mobilenetv2",
        backbone: Path | None = None,
    ) -> None:
        super().__init__(data, size, seed, variation)
        self.width, self.architecture = width, architecture
        network = SegmentationNetwork(len(data.classes), backbone=BACKBONES[architecture](width))
        self.network: nn.Module = network
        self.backbone, self.decoder = network.backbone, network.decoder
        self.class_weights = class_weights(data)
        if backbone is not None:
            load_backbone(self.backbone, backbone)

    def begin_with(self, file: Path) -> None:
        """Begins with the weights of a network file. Raises `TrainingFileError` where they do not fit."""
        self.check(file)
        begin_with(self.network, file, sample_images(self))

    def check(self, file: Path) -> None:
        """Raises `TrainingFileError` for a network file of another kind, architecture, or of other classes."""
        fitting_facts(file, kind=self.kind, architecture=self._name, classes=list(self.data.classes))

    @property
    def _name(self) -> str:
        return f"{self.architecture}-{self.width:g} decoder"

    def description(self) -> dict[str, Any]:
        return self._description(width=self.width, architecture=self.architecture)

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor]:
        views = [
            self.data.training[k].view(len(self.data.classes), self.size, self.variation, rng)
            for k, rng in zip(samples, rngs, strict=True)
        ]
        images = np.stack([tensor_of(pixels) for pixels, _ in views])
        return torch.from_numpy(images), torch.from_numpy(np.stack([mask for _, mask in views]).astype(np.int64))

    def loss(self, batch: tuple[Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        images, masks = batch
        return self.loss_of(self.network(images.to(device).contiguous(memory_format=torch.channels_last)), masks)

    def loss_of(self, scores: Tensor, masks: Tensor) -> dict[str, Tensor]:
        """The parts of the loss of what the network answered to images with these `masks` (N, H, W)."""
        device, scores, masks = scores.device, scores.float(), masks.to(scores.device)
        # Compared at half the resolution, in which the network answers; every second pixel of the truth.
        masks = masks[:, ::2, ::2]
        entropy = functional.cross_entropy(scores, masks, self.class_weights.to(device), ignore_index=VOID)
        return {"entropy": entropy, "dice": dice_loss(scores, masks)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        device = next(network.parameters()).device
        classes = len(self.data.classes)
        table = np.zeros((classes, classes + 1), np.int64)
        for image in self.data.validation:
            pixels, mask = image.view(len(self.data.classes), self.size, self.variation, None)
            with torch.inference_mode():
                scores = network(torch.from_numpy(tensor_of(pixels))[None].to(device))
                scores = enlarged(scores, mask.shape)
            table += confusion(mask, scores.argmax(dim=1)[0].cpu().numpy().astype(np.uint8), classes)
        score = mean_iou(table)
        return {"score": score, "miou": score}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        described = self._facts(self._name, facts, self.data.origin)
        if len(self.data.classes) <= MOST_CLASSES:
            step = self._step(network)
            export_network(
                ScoringSegmenter(network, step), self.size, ["scores"], {**described, "score_step": step}, file
            )
            return
        deployed = DeployedSegmenter(network, (self.size[1], self.size[0]))
        export_network(deployed, self.size, ["classes", "confidence"], described, file)

    def _step(self, network: nn.Module) -> float:
        """A step of scores in 8 bits such that the widest gap in a few images takes 255, but not beyond `WIDEST`."""
        device, widest = next(network.parameters()).device, 0.0
        for image in self.data.validation[:_MEASURED]:
            pixels, _ = image.view(len(self.data.classes), self.size, self.variation, None)
            with torch.inference_mode():
                scores = network(torch.from_numpy(tensor_of(pixels))[None].to(device))
            widest = max(widest, float((scores.amax(dim=1) - scores.amin(dim=1)).max()))
        return min(WIDEST, max(widest, 1e-3) / 255)


def class_weights(data: SegmentationData, most: int = 200) -> Tensor:
    """Weights (C,) float32 that fall with the fourth root of a class's share of the pixels, at most 4 times the least.

    With stronger ones, small objects grow over their borders.
    """
    counts = np.zeros(len(data.classes), np.float64)
    step = max(1, len(data.training) // most)
    for image in data.training[::step]:
        mask = image.read(len(data.classes))[1]
        counts += np.bincount(mask[mask != VOID], minlength=len(counts))
    shares = np.maximum(counts / max(counts.sum(), 1), 1e-9)
    weights = np.minimum((shares.max() / shares) ** 0.25, 4.0)
    return torch.from_numpy((weights / np.average(weights, weights=shares)).astype(np.float32))


def dice_loss(scores: Tensor, masks: Tensor) -> Tensor:
    """1 - Dice of the classes in the batch (Milletari 2016): it counts a small class as much as a large one."""
    classes = scores.shape[1]
    known = masks != VOID
    label = masks.where(known, 0)
    probability = scores.softmax(dim=1) * known[:, None]
    counts = torch.bincount(label[known], minlength=classes).to(scores.dtype)
    hit = probability.gather(1, label[:, None])[:, 0]
    overlap = torch.zeros_like(counts).index_add(0, label.flatten(), hit.flatten())
    dice = (2 * overlap + 1) / (probability.sum(dim=(0, 2, 3)) + counts + 1)
    present = counts > 0
    return (1 - dice[present]).mean() if bool(present.any()) else scores.sum() * 0
