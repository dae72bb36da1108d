"""Training of the grid detector, as a task for the training loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from operators.detection.custom.anchors import fit_anchors, mean_best_iou
from operators.detection.custom.augmentation import DetectionSample, moved_boxes, view
from operators.detection.custom.dataset import DetectionData, LabelledImage
from operators.detection.custom.decode import find_boxes
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.custom.loss import Truth, detection_loss
from operators.detection.custom.network import ANCHORS_PER_CELL, STRIDES, GridDetector
from operators.learning.augmentation import Variation, fitted, tensor_of, warp
from operators.learning.backbone import BACKBONES, Backbone, load_backbone
from operators.learning.export import export_network
from operators.learning.network_weights import begin_with, fitting_facts, sample_images
from operators.weights.network_file import TRAINED_ON

KIND = "detector"
STEP = 16
_SCORING = (0.01, 0.5, 100)  # least score, overlap for suppression, most boxes


class DetectorTask:
    """Trains a GridDetector of input `size` (width, height; multiples of 16) on labelled images."""

    kind = KIND

    def __init__(
        self,
        data: DetectionData,
        size: tuple[int, int] = (320, 240),
        *,
        seed: int = 0,
        width: float = 1.0,
        variation: Variation | None = None,
        architecture: str = "mobilenetv2",
        strides: Sequence[int] = STRIDES,
        channels: int = 96,
        backbone: Path | None = None,
    ) -> None:
        if any(extent % STEP or extent <= 0 for extent in size):
            raise ValueError(f"the input's width and height must be multiples of {STEP}, got {size[0]}x{size[1]}")
        torch.manual_seed(seed)
        self.data, self.size = data, size
        self.variation = Variation() if variation is None else variation
        sizes = object_sizes(data.training, size)
        anchors = fit_anchors(sizes, len(strides) * ANCHORS_PER_CELL, seed)
        self.anchor_fit = mean_best_iou(sizes, anchors)
        self.anchors = anchors.reshape(len(strides), ANCHORS_PER_CELL, 2)
        self.width, self.architecture, self.strides = width, architecture, tuple(strides)
        made = BACKBONES[architecture](width)
        self.detector = GridDetector(len(data.classes), channels=channels, backbone=made, strides=strides)
        if backbone is not None:
            load_backbone(self.detector.backbone, backbone)

    @property
    def network(self) -> nn.Module:
        return self.detector

    @property
    def backbone(self) -> Backbone:
        return self.detector.backbone

    @property
    def samples(self) -> int:
        return len(self.data.training)

    def begin_with(self, file: Path) -> None:
        """Begins with weights and anchors of a network file. Raises `TrainingFileError` where they do not fit."""
        self.take_anchors(file)
        begin_with(self.detector, file, sample_images(self))

    def take_anchors(self, file: Path) -> None:
        """Takes the anchors of a network file of this kind, scaled to this input."""
        facts = fitting_facts(
            file, kind=KIND, architecture=self._name, classes=list(self.data.classes), strides=list(self.strides)
        )
        scale = np.array(self.size, np.float32) / (facts["width"], facts["height"])
        self.anchors = np.asarray(facts["anchors"], np.float32) * scale.astype(np.float32)

    @property
    def _name(self) -> str:
        return f"{self.architecture}-{self.width:g} fpn grid"

    def description(self) -> dict[str, Any]:
        return {
            "classes": list(self.data.classes),
            "size": list(self.size),
            "width": self.width,
            "architecture": self.architecture,
            "strides": list(self.strides),
            "anchors": np.round(self.anchors, 3).tolist(),
            "images": self.samples,
        }

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Truth]:
        views = [
            view(self.data.training[k], self.size, self.variation, rng) for k, rng in zip(samples, rngs, strict=True)
        ]
        return torch.from_numpy(np.stack([tensor_of(v.pixels) for v in views])), truth_of(views)

    def loss(self, batch: tuple[Tensor, Truth], device: torch.device) -> dict[str, Tensor]:
        images, truth = batch
        return self.loss_of(self.detector(images.to(device).contiguous(memory_format=torch.channels_last)), truth)

    def loss_of(self, maps: Sequence[Tensor], truth: Truth) -> dict[str, Tensor]:
        """The parts of the loss of what the network answered."""
        device, maps = maps[0].device, [m.float() for m in maps]
        anchors = torch.from_numpy(self.anchors).to(device)
        return detection_loss(maps, truth.to(device), anchors, self.strides, len(self.data.classes))

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        device = next(network.parameters()).device

        def maps(pixels: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
            with torch.inference_mode():
                found = network(torch.from_numpy(tensor_of(pixels))[None].to(device))
            return [m.cpu().numpy() for m in found]

        scored = []
        for image in self.data.validation:
            pixels = image.read()
            size = (pixels.shape[1], pixels.shape[0])
            affine = fitted(size, self.size)
            boxes, _ = moved_boxes(image.boxes * np.array([*size, *size], np.float32), image.ignored, affine, self.size)
            output = maps(warp(pixels, affine, self.size))
            found = find_boxes(output, self.anchors, self.strides, len(self.data.classes), *_SCORING)
            scored.append(ScoredImage(boxes, image.classes, image.ignored, found))
        score = score_detections(scored, self.data.classes)
        return {"score": score.ap50, "ap50": score.ap50, "ap": score.ap}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        described = {
            "kind": KIND,
            "architecture": self._name,
            "classes": list(self.data.classes),
            "width": self.size[0],
            "height": self.size[1],
            "strides": list(self.strides),
            "anchors": np.round(self.anchors.astype(float), 4).tolist(),
            "training_images": self.samples,
            **({TRAINED_ON: self.data.origin} if self.data.origin else {}),
            **facts,
        }
        export_network(network, self.size, [f"stride{s}" for s in self.strides], described, file)


def object_sizes(images: tuple[LabelledImage, ...], size: tuple[int, int]) -> NDArray[np.float32]:
    """Widths and heights (N, 2) of the objects to be found, in pixels of the network's input."""
    rows = [np.zeros((0, 2), np.float32)]
    for image in images:
        wanted = image.boxes[~image.ignored]
        if not len(wanted):
            continue
        extent = image.size
        if extent is None:
            pixels = image.read()
            extent = (pixels.shape[1], pixels.shape[0])
        affine = fitted(extent, size)
        scale = np.array([extent[0] * affine[0, 0], extent[1] * affine[1, 1]], np.float32)
        rows.append((wanted[:, 2:] - wanted[:, :2]) * scale)
    return np.concatenate(rows)


def truth_of(views: Sequence[DetectionSample]) -> Truth:
    """The objects in the views, as a batch."""
    return Truth(
        torch.from_numpy(np.repeat(np.arange(len(views)), [len(v.boxes) for v in views])),
        torch.from_numpy(np.concatenate([v.classes for v in views]).astype(np.int64)),
        torch.from_numpy(np.concatenate([v.boxes for v in views])),
        torch.from_numpy(np.concatenate([v.ignored for v in views])),
    )
