"""Detector and segmenter trained together: one backbone learns from boxes and from masks of the same images.

At run time they are two networks, in two files.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from operators.detection.custom.augmentation import seen_through
from operators.detection.custom.dataset import DataError, DetectionData
from operators.detection.custom.loss import Truth
from operators.detection.custom.network import FINE_STRIDES
from operators.detection.custom.training import DetectorTask, truth_of
from operators.learning.augmentation import Variation, fitted, tensor_of, varied, warp
from operators.learning.backbone import Backbone
from operators.learning.network_weights import begin_with, sample_images
from operators.segmentation.dataset import VOID, MaskedImage, SegmentationData
from operators.segmentation.training import SegmenterTask

DETECTOR, SEGMENTER = "detector.onnx", "segmenter.onnx"
_CHANNELS = 64


class PairNetwork(nn.Module):
    """A backbone with a grid detector's head and a segmenter's decoder."""

    def __init__(self, backbone: Backbone, grid: nn.Module, decoder: nn.Module) -> None:
        super().__init__()
        self.backbone, self.grid, self.decoder = backbone, grid, decoder

    def forward(self, images: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
        maps = self.backbone(images)
        return self.grid(maps), self.decoder(maps)


class PairTask:
    """Trains both networks for an input `size` (width, height) on images that have boxes and masks.

    Raises DataError where an image with boxes has no mask.
    """

    kind = "pair"

    def __init__(
        self,
        boxes: DetectionData,
        masks: SegmentationData,
        size: tuple[int, int] = (320, 240),
        *,
        seed: int = 0,
        width: float = 1.0,
        architecture: str = "smallresnet",
        variation: Variation | None = None,
    ) -> None:
        self.boxes = DetectorTask(
            boxes,
            size,
            seed=seed,
            width=width,
            variation=variation,
            architecture=architecture,
            strides=FINE_STRIDES,
            channels=_CHANNELS,
        )
        self.masks = SegmenterTask(masks, size, seed=seed, width=width, variation=variation, architecture=architecture)
        mask_of = {image.image.name: image for image in (*masks.training, *masks.validation)}
        lacking = [image.file for image in boxes.training if image.file.name not in mask_of]
        if lacking:
            raise DataError(f"{len(lacking)} images have boxes and no mask, the first is {lacking[0]}")
        self.mask_of: list[MaskedImage] = [mask_of[image.file.name] for image in boxes.training]
        self.size, self.samples, self.variation = size, self.boxes.samples, self.boxes.variation
        self.backbone = self.boxes.backbone
        self.network = PairNetwork(self.backbone, self.boxes.network.head, self.masks.decoder)

    def begin_with(self, file: Path) -> None:
        """Begins with `detector.onnx` and the `segmenter.onnx` beside it, whose backbones were one; the detector's
        counts. Raises `TrainingFileError` where they do not fit."""
        other = file.with_name(SEGMENTER)
        self.boxes.take_anchors(file)
        self.masks.check(other)
        images = sample_images(self)
        begin_with(nn.Sequential(self.backbone, self.network.decoder), other, images)
        begin_with(nn.Sequential(self.backbone, self.network.grid), file, images)

    def description(self) -> dict[str, Any]:
        return {"detector": self.boxes.description(), "segmenter": self.masks.description()}

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Truth, Tensor]:
        views, masks = [], []
        for k, rng in zip(samples, rngs, strict=True):
            pixels, mask = self.mask_of[k].read(len(self.masks.data.classes))
            affine = fitted((pixels.shape[1], pixels.shape[0]), self.size)
            affine = varied(affine, self.size, self.variation, rng)
            masks.append(warp(mask, affine, self.size, border=VOID, labels=True))
            image = self.boxes.data.training[k]
            views.append(seen_through(image, pixels, affine, self.size, self.variation, rng))
        images = torch.from_numpy(np.stack([tensor_of(v.pixels) for v in views]))
        return images, truth_of(views), torch.from_numpy(np.stack(masks).astype(np.int64))

    def loss(self, batch: tuple[Tensor, Truth, Tensor], device: torch.device) -> dict[str, Tensor]:
        images, truth, masks = batch
        maps, scores = self.network(images.to(device).contiguous(memory_format=torch.channels_last))
        return {**self.boxes.loss_of(maps, truth), **self.masks.loss_of(scores, masks)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        detector, segmenter = _apart(network)
        boxes, masks = self.boxes.evaluate(detector), self.masks.evaluate(segmenter)
        return {
            "score": (boxes["score"] + masks["score"]) / 2,
            **{name: value for scores in (boxes, masks) for name, value in scores.items() if name != "score"},
        }

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Writes `detector.onnx` and `segmenter.onnx` beside `file`."""
        detector, segmenter = _apart(network)
        self.boxes.export(detector, facts, file.with_name(DETECTOR))
        self.masks.export(segmenter, facts, file.with_name(SEGMENTER))


def _apart(network: nn.Module) -> tuple[nn.Module, nn.Module]:
    assert isinstance(network, PairNetwork)
    return nn.Sequential(network.backbone, network.grid), nn.Sequential(network.backbone, network.decoder)
