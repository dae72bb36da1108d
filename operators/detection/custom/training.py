"""Training of the grid detector, as a task for the training loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from operators.detection.custom.augmentation import DetectionSample, moved_boxes, view
from operators.detection.custom.dataset import DetectionData, LabelledImage
from operators.detection.custom.decode import find_boxes
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.custom.loss import Truth, detection_loss
from operators.detection.custom.network import ANCHORS_PER_CELL, STRIDES, GridDetector
from operators.learning.augmentation import Variation, fitted, tensor_of, warp
from operators.learning.backbone import BACKBONES, load_backbone
from operators.learning.export import export_network
from operators.learning.image_task import ImageTask
from operators.learning.network_weights import begin_with, fitting_facts, sample_images

Sizes = NDArray[np.float32]
"""(N, 2) widths and heights in pixels."""
_SCORING = (0.01, 0.5, 100)  # least score, overlap for suppression, most boxes


def size_iou(sizes: Sizes, anchors: Sizes) -> NDArray[np.float32]:
    """IoU (N, K) of boxes that share their centre."""
    intersection = np.minimum(sizes[:, None], anchors[None]).prod(axis=2)
    union = sizes.prod(axis=1)[:, None] + anchors.prod(axis=1)[None] - intersection
    iou: NDArray[np.float32] = (intersection / np.maximum(union, 1e-9)).astype(np.float32)
    return iou


def fit_anchors(sizes: Sizes, count: int, seed: int, rounds: int = 50) -> Sizes:
    """`count` anchors (count, 2) by growing area, for objects of these sizes in the network's input: k-means by IoU.

    Where there are fewer distinct sizes than anchors, the rest are scaled copies of the found ones. Raises ValueError
    without any size.
    """
    sizes = np.maximum(np.asarray(sizes, np.float32).reshape(-1, 2), 1)
    if not len(sizes):
        raise ValueError("anchors need at least one object")
    distinct = np.unique(sizes, axis=0)
    start = np.random.default_rng(seed).permutation(len(distinct))[:count]
    anchors = distinct[np.sort(start)]
    for _ in range(rounds):
        nearest = size_iou(sizes, anchors).argmax(axis=1)
        moved = np.stack(
            [
                np.median(sizes[nearest == k], axis=0) if (nearest == k).any() else anchors[k]
                for k in range(len(anchors))
            ]
        ).astype(np.float32)
        if np.array_equal(moved, anchors):
            break
        anchors = moved
    scales = 2.0 ** np.array([0, 1, -1, 2, -2, 3, -3, 0.5, -0.5, 1.5, -1.5, 2.5])
    copies = np.concatenate([anchors * s for s in scales]) if len(anchors) < count else anchors
    chosen = copies[:count].astype(np.float32)
    return chosen[np.lexsort((chosen[:, 0], chosen.prod(axis=1)))]


def mean_best_iou(sizes: Sizes, anchors: Sizes) -> float:
    """Returns how well the anchors cover the sizes: the mean over objects of the best anchor's IoU."""
    return float(size_iou(np.asarray(sizes, np.float32), anchors).max(axis=1).mean())


class DetectorTask(ImageTask[DetectionData]):
    """Trains a GridDetector of input `size` (width, height; multiples of 16) on labelled images."""

    kind, step = "detector", 16

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
        super().__init__(data, size, seed, variation)
        sizes = object_sizes(data.training, size)
        anchors = fit_anchors(sizes, len(strides) * ANCHORS_PER_CELL, seed)
        self.anchor_fit = mean_best_iou(sizes, anchors)
        self.anchors = anchors.reshape(len(strides), ANCHORS_PER_CELL, 2)
        self.width, self.architecture, self.strides = width, architecture, tuple(strides)
        made = BACKBONES[architecture](width)
        self.network = GridDetector(len(data.classes), channels=channels, backbone=made, strides=strides)
        self.backbone = self.network.backbone
        if backbone is not None:
            load_backbone(self.backbone, backbone)

    def begin_with(self, file: Path) -> None:
        """Begins with weights and anchors of a network file. Raises `TrainingFileError` where they do not fit."""
        self.take_anchors(file)
        begin_with(self.network, file, sample_images(self))

    def take_anchors(self, file: Path) -> None:
        """Takes the anchors of a network file of this kind, scaled to this input."""
        facts = fitting_facts(
            file, kind=self.kind, architecture=self._name, classes=list(self.data.classes), strides=list(self.strides)
        )
        scale = np.array(self.size, np.float32) / (facts["width"], facts["height"])
        self.anchors = np.asarray(facts["anchors"], np.float32) * scale.astype(np.float32)

    @property
    def _name(self) -> str:
        return f"{self.architecture}-{self.width:g} fpn grid"

    def description(self) -> dict[str, Any]:
        return self._description(
            width=self.width,
            architecture=self.architecture,
            strides=list(self.strides),
            anchors=np.round(self.anchors, 3).tolist(),
        )

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Truth]:
        views = [
            view(self.data.training[k], self.size, self.variation, rng) for k, rng in zip(samples, rngs, strict=True)
        ]
        return torch.from_numpy(np.stack([tensor_of(v.pixels) for v in views])), truth_of(views)

    def loss(self, batch: tuple[Tensor, Truth], device: torch.device) -> dict[str, Tensor]:
        images, truth = batch
        return self.loss_of(self.network(images.to(device).contiguous(memory_format=torch.channels_last)), truth)

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
        own = {"strides": list(self.strides), "anchors": np.round(self.anchors.astype(float), 4).tolist()}
        described = self._facts(self._name, facts, self.data.origin, **own)
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
