"""Training of the second look at the borders of a trained segmenter's classes, as a task for the training loop."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.detection.fit import Fit
from operators.segmentation.border_network import BorderNetwork, DeployedBorders
from operators.segmentation.borders import (
    BLOCK,
    GRAIN,
    KIND,
    SEEN,
    Blocks,
    best_cells,
    found_blocks,
    look_again,
    scored,
    worked,
)
from operators.segmentation.dataset import VOID, MaskedImage, SegmentationData
from operators.segmentation.labelled import enlarged
from operators.segmentation.score import confusion, mean_iou
from operators.segmentation.scores import best_classes
from operators.training.augmentation import Variation, recolored
from operators.training.export import export_rows, without_second
from operators.training.files import TrainingFileError
from operators.weights import open_network

_ROWS, _KEPT = 900_000, 1500
"""Blocks that are kept to learn from, of all images and of one, at most: they stay in memory, 0.6 kB each."""
_CHUNK = 64
"""Blocks that are varied alike and stay together: one sample of the training loop."""

Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Pixels, preferences, first and second class, and the true class of each pixel, of N blocks."""


class BorderTask:
    """Trains the network that looks again at the borders of what the segmenter in `file` answers."""

    kind = KIND

    def __init__(
        self, data: SegmentationData, file: Path, *, seed: int = 0, variation: Variation | None = None
    ) -> None:
        torch.manual_seed(seed)
        self.data, self.file = data, file
        self.variation = Variation() if variation is None else variation
        self._first = open_network(file, "segmenter")
        if self._first.classes != data.classes:
            raise TrainingFileError(
                f"{file} knows {', '.join(self._first.classes)}; the data have {', '.join(data.classes)}"
            )
        if not scored(self._first):
            raise TrainingFileError(f"{file} gives no scores to look at again: it has more than 32 classes, or is old")
        self._step = float(self._first.facts["score_step"])
        self.borders = BorderNetwork(len(data.classes))
        self._rows = self._gathered(np.random.default_rng(seed))

    @property
    def network(self) -> nn.Module:
        return self.borders

    @property
    def samples(self) -> int:
        return max(1, len(self._rows[0]) // _CHUNK)

    def description(self) -> dict[str, Any]:
        return {
            "classes": list(self.data.classes),
            "images": len(self.data.training),
            "segmenter": hashlib.sha256(without_second(self.file)).hexdigest(),
        }

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> Batch:
        parts = []
        for k, rng in zip(samples, rngs, strict=True):
            rows = slice(k * _CHUNK, (k + 1) * _CHUNK)
            pixels, preferences, first, second, truth = (column[rows] for column in self._rows)
            if rng.random() < self.variation.flip:
                pixels, preferences, truth = pixels[:, :, ::-1], preferences[:, :, ::-1], truth[:, :, ::-1]
            seen = recolored(np.ascontiguousarray(pixels).reshape(-1, SEEN, 3), self.variation, rng)
            parts.append((seen.reshape(-1, SEEN, SEEN, 3), preferences, first, second, truth))
        columns = [
            torch.from_numpy(np.ascontiguousarray(np.concatenate(column))) for column in zip(*parts, strict=True)
        ]
        return columns[0], columns[1].float(), columns[2].long(), columns[3].long(), columns[4].flatten(1)

    def loss(self, batch: Batch, device: torch.device) -> dict[str, Tensor]:
        pixels, preferences, first, second, truth = (each.to(device) for each in batch)
        sides = self.borders(pixels, preferences, first, second).float()
        own, other = truth == first[:, None], truth == second[:, None]
        entropy = functional.binary_cross_entropy_with_logits(sides, own.to(sides.dtype), reduction="none")
        known = own | other
        return {"side": (entropy * known).sum() / known.sum().clamp(min=1)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        device, count = next(network.parameters()).device, len(self.data.classes)

        def answer(blocks: Blocks) -> NDArray[np.float32]:
            given = (torch.from_numpy(np.array(blocks.pixels)), torch.from_numpy(blocks.preferences))
            classes = (torch.from_numpy(each.astype(np.int64)) for each in (blocks.first, blocks.second))
            with torch.inference_mode():
                found: NDArray[np.float32] = network(*(each.to(device) for each in (*given, *classes))).cpu().numpy()
            return found

        before, after = (np.zeros((count, count + 1), np.int64) for _ in range(2))
        for image in self.data.validation:
            pixels, mask = image.read(count)
            fit, scores = self._scores(pixels)
            before += confusion(
                mask, np.asarray(enlarged(best_classes(scores), fit, cv2.INTER_NEAREST), np.uint8), count
            )
            after += confusion(mask, look_again(answer, scores, self._step, pixels, fit), count)
        score = mean_iou(after)
        return {"score": score, "miou": score, "miou_before": mean_iou(before)}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        """Writes this network alone; `attach_second` puts it into the segmenter's file."""
        described = {
            "kind": KIND,
            "classes": list(self.data.classes),
            "training_images": len(self.data.training),
            **facts,
        }
        examples = {
            "pixels": torch.zeros(2, SEEN, SEEN, 3, dtype=torch.uint8),
            "preferences": torch.zeros(2, SEEN // GRAIN, SEEN // GRAIN),
            "first": torch.zeros(2, dtype=torch.int64),
            "second": torch.zeros(2, dtype=torch.int64),
        }
        assert isinstance(network, BorderNetwork)
        export_rows(DeployedBorders(network), examples, ["sides"], described, file)

    def _scores(self, pixels: NDArray[np.uint8]) -> tuple[Fit, NDArray[np.uint8]]:
        fit = Fit.plan("letterbox", (pixels.shape[1], pixels.shape[0]), self._first.size)
        return fit, self._first.run(fit.apply(pixels))[0][0]

    def _gathered(self, rng: np.random.Generator) -> tuple[NDArray[Any], ...]:
        """Blocks of all images in random order, by column, with the true class (4, 4) of each."""
        images = self.data.training
        most = max(_CHUNK, min(_KEPT, _ROWS // len(images)))
        parts = [self._of_image(image, most, rng) for image in images]
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        if not len(columns[0]):
            raise TrainingFileError(f"{self.file} sees no border between two classes in any of {len(images)} images")
        order = rng.permutation(len(columns[0]))
        return tuple(column[order] for column in columns)

    def _of_image(self, image: MaskedImage, most: int, rng: np.random.Generator) -> Sequence[NDArray[Any]]:
        pixels, mask = image.read(len(self.data.classes))
        fit, scores = self._scores(pixels)
        shown, placed = worked(pixels, fit)
        coarse, blocks = found_blocks(scores, self._step, *best_cells(scores), shown, placed)
        truth = np.full(coarse.shape, VOID, np.uint8)
        size = (shown.shape[1], shown.shape[0])
        truth[: size[1], : size[0]] = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        tiles = truth.reshape(len(truth) // BLOCK, BLOCK, -1, BLOCK).transpose(0, 2, 1, 3)
        chosen = np.sort(rng.permutation(len(blocks.at))[:most])
        column, row = blocks.at[chosen].T
        return (
            blocks.pixels[chosen],
            blocks.preferences[chosen].astype(np.float16),
            blocks.first[chosen],
            blocks.second[chosen],
            tiles[row, column],
        )
