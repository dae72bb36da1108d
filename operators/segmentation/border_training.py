"""Training of the second look at the borders of a trained segmenter's classes, as a task for the training loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.image.letterbox import ImageFit
from operators.learning.augmentation import Variation, recolored
from operators.learning.files import TrainingFileError
from operators.learning.second_stage import Columns, SecondTask, answered
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
from operators.weights import open_network

_HIDDEN, _LAST = 64, 48
_LEVELS = 64.0
_SURE = 3.0
"""A preference beyond which a class is sure."""
_ROWS, _KEPT = 900_000, 1500
"""Blocks that are kept to learn from, of all images and of one, at most: they stay in memory, 0.6 kB each."""
Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""Pixels, preferences, first and second class, and the true class of each pixel, of N blocks."""


class BorderNetwork(nn.Module):
    """Blocks (`operators.segmentation.borders.Blocks`) → (N, 16), above 0 where a pixel is of the first class.

    Colours count from the mean of what is seen, since light changes them all alike.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        count = (SEEN // GRAIN) ** 2
        self.seen = nn.Linear(SEEN * SEEN * 3 + 3, _HIDDEN)
        self.preferred = nn.Linear(2 * count, _HIDDEN)
        self.first, self.second = nn.Embedding(classes, _HIDDEN), nn.Embedding(classes, _HIDDEN)
        self.mixed = nn.Sequential(nn.ReLU(), nn.Linear(_HIDDEN, _LAST), nn.ReLU(), nn.Linear(_LAST, BLOCK * BLOCK))
        for embedding in (self.first, self.second):
            nn.init.zeros_(embedding.weight)

    def forward(self, pixels: Tensor, preferences: Tensor, first: Tensor, second: Tensor) -> Tensor:
        seen = pixels.float().flatten(1, 2) / _LEVELS
        mean = seen.mean(dim=1)
        return self.decide(
            self.seen(torch.cat([(seen - mean[:, None]).flatten(1), mean], dim=1)), preferences, first, second
        )

    def decide(self, seen: Tensor, preferences: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """Goes on from the first layer's answer (N, H) to the pixels."""
        rough = (preferences / _SURE).flatten(1)
        x = seen + self.preferred(torch.cat([rough.clamp(-1, 1), rough / 4], dim=1))
        answer: Tensor = self.mixed(x + self.first(first) + self.second(second))
        return answer


class DeployedBorders(nn.Module):
    """Computes the same as the file does, the first layer in integers.

    That layer takes pixels of 8 bits as they are: taking off the mean is a part of its weights. These are rounded to 7
    bits, by output, so that no sum overflows on processors without VNNI instructions.
    """

    def __init__(self, network: BorderNetwork) -> None:
        super().__init__()
        self.network = network
        weight, values = network.seen.weight.detach(), SEEN * SEEN
        apart, together = weight[:, : 3 * values], weight[:, 3 * values :]
        colors = apart.reshape(-1, values, 3)
        folded = (colors - colors.mean(dim=1, keepdim=True) + together[:, None] / values).flatten(1) / _LEVELS
        step = folded.abs().amax(dim=1).clamp(min=1e-12) / 63
        self.register_buffer("whole", (folded / step[:, None]).round().t().contiguous())
        self.register_buffer("step", step)

    def forward(self, pixels: Tensor, preferences: Tensor, first: Tensor, second: Tensor) -> Tensor:
        sums = pixels.flatten(1).float() @ self.get_buffer("whole")
        seen = sums * self.get_buffer("step") + self.network.seen.bias
        return self.network.decide(seen, preferences, first, second)


class BorderTask(SecondTask[MaskedImage, Batch]):
    """Trains the network that looks again at the borders of what the segmenter in `file` answers."""

    kind, first, chunk = KIND, "segmenter", 64

    def __init__(
        self, data: SegmentationData, file: Path, *, seed: int = 0, variation: Variation | None = None
    ) -> None:
        self._first = open_network(file, "segmenter")
        super().__init__(data, file, self._first.classes, seed, variation)
        if not scored(self._first):
            raise TrainingFileError(f"{file} gives no scores to look at again: it has more than 32 classes, or is old")
        self._step = float(self._first.facts["score_step"])
        self.network = BorderNetwork(len(data.classes))
        self._gather(max(self.chunk, min(_KEPT, _ROWS // len(data.training))), seed)

    def loss(self, batch: Batch, device: torch.device) -> dict[str, Tensor]:
        pixels, preferences, first, second, truth = (each.to(device) for each in batch)
        sides = self.network(pixels, preferences, first, second).float()
        own, other = truth == first[:, None], truth == second[:, None]
        entropy = functional.binary_cross_entropy_with_logits(sides, own.to(sides.dtype), reduction="none")
        known = own | other
        return {"side": (entropy * known).sum() / known.sum().clamp(min=1)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        count = len(self.data.classes)

        def answer(blocks: Blocks) -> NDArray[np.float32]:
            first, second = (each.astype(np.int64) for each in (blocks.first, blocks.second))
            return answered(network, np.array(blocks.pixels), blocks.preferences, first, second)

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
        examples = {
            "pixels": torch.zeros(2, SEEN, SEEN, 3, dtype=torch.uint8),
            "preferences": torch.zeros(2, SEEN // GRAIN, SEEN // GRAIN),
            "first": torch.zeros(2, dtype=torch.int64),
            "second": torch.zeros(2, dtype=torch.int64),
        }
        assert isinstance(network, BorderNetwork)
        self._write(DeployedBorders(network), examples, {}, facts, file)

    def _varied(self, rows: Columns, rng: np.random.Generator) -> Columns:
        pixels, preferences, first, second, truth = rows
        if rng.random() < self.variation.flip:
            pixels, preferences, truth = pixels[:, :, ::-1], preferences[:, :, ::-1], truth[:, :, ::-1]
        seen = recolored(np.ascontiguousarray(pixels).reshape(-1, SEEN, 3), self.variation, rng)
        return seen.reshape(-1, SEEN, SEEN, 3), preferences, first, second, truth

    def _batch(self, columns: list[Tensor], rngs: list[np.random.Generator]) -> Batch:
        pixels, preferences, first, second, truth = columns
        return pixels, preferences.float(), first.long(), second.long(), truth.flatten(1)

    def _scores(self, pixels: NDArray[np.uint8]) -> tuple[ImageFit, NDArray[np.uint8]]:
        fit = ImageFit.plan("letterbox", (pixels.shape[1], pixels.shape[0]), self._first.size)
        return fit, self._first.run(fit.apply(pixels))[0][0]

    def _of_image(self, image: MaskedImage, most: int, rng: np.random.Generator) -> Columns:
        """Blocks of an image, with the true class (4, 4) of each pixel."""
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
