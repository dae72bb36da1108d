"""Training of a refiner on the boxes that a trained detector finds, as a task for the training loop."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.detection.custom.closeup import MARGIN, PIXELS, closeups, numbers, places, windows
from operators.detection.custom.dataset import DetectionData, LabelledImage
from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.custom.first_look import FirstStage
from operators.detection.custom.loss import complete_iou
from operators.detection.custom.refiner import DEQUANTIZED, KIND, RefinerSettings, inner_names, look_again
from operators.detection.custom.surroundings import surroundings
from operators.detection.nms import intersection_over_union
from operators.learning.augmentation import Variation, recolored
from operators.learning.files import TrainingFileError
from operators.learning.second_stage import Columns, SecondTask, answered
from operators.weights import open_network

_HIDDEN, _LAST, _AROUND = 160, 64, 128
_ALONG, _WHOLE = 12, 12
"""Samples along a side, and along the sides of what is seen of the whole."""
_FORGOTTEN = 0.25
"""Share of values that training leaves out, so that no object is learned by heart."""
SIDE = 48
LEAST, MOST = 0.08, 64
_SCORING = (0.01, 0.5, 100)  # least score, overlap for suppression, most boxes
_SAME = 0.4
"""Overlap from which a box is of an object."""
_JITTER, _ASTRAY = 0.05, 0.12
"""Standard deviations by which sides of found boxes and of true ones are moved, as shares of the box's size."""
_ROWS, _SHOWN = 100_000, 150
"""Boxes that are kept to learn from, of all images and of one, at most: they stay in memory, 17 kB each."""
_STRIDES = (8, 16)
_HEAD = re.compile(r"/heads\.(\d+)/")


class RefinerNetwork(nn.Module):
    """Close-ups (N, S, S, 3) uint8, surroundings (N, A) and places (N, F) → sides (N, 4), shares of the window.

    Every side is seen as if it were the left one: the half of the close-up beside it, fine across the side and coarse
    along it, and the whole, coarse. So one set of weights learns from all four sides. The surroundings differ.
    """

    def __init__(self, classes: int, side: int, around: int) -> None:
        super().__init__()
        if side % 12:
            raise ValueError(f"a close-up's side must be a multiple of 12, got {side}")
        self.side = side
        known = numbers(classes)
        strip, whole = side // 2 * _ALONG * 3, _WHOLE * _WHOLE * 3
        self.strip, self.whole = nn.Linear(strip, _HIDDEN), nn.Linear(whole, _HIDDEN)
        self.around = nn.Sequential(
            nn.Dropout(_FORGOTTEN), nn.Linear(around, _AROUND), nn.ReLU(), nn.Dropout(_FORGOTTEN)
        )
        self.known = nn.Linear(_AROUND + known, 4 * _HIDDEN)  # of each side for itself: a foot is not a head
        self.mixed = nn.Sequential(
            nn.ReLU(),
            nn.Dropout(_FORGOTTEN),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(),
            nn.Dropout(_FORGOTTEN),
            nn.Linear(_HIDDEN, _LAST),
            nn.ReLU(),
            nn.Linear(_LAST, 1),
        )
        last = self.mixed[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # begins by leaving boxes where they are
        nn.init.zeros_(last.bias)
        self.register_buffer("signs", torch.tensor([-1.0, -1.0, 1.0, 1.0]), persistent=False)

    def forward(self, closeups: Tensor, surroundings: Tensor, places: Tensor) -> Tensor:
        x = closeups.permute(0, 3, 1, 2).float() / 64
        x = x - x.mean(dim=(2, 3), keepdim=True)
        half, along = self.side // 2, self.side // _ALONG
        across = functional.avg_pool2d(x, (along, 1)), functional.avg_pool2d(x, (1, along)).transpose(2, 3)
        strips = [each[..., :half] for each in across] + [each.flip(3)[..., :half] for each in across]
        small = functional.avg_pool2d(x, self.side // _WHOLE)
        wholes = [small, small.transpose(2, 3), small.flip(3), small.flip(2).transpose(2, 3)]
        # Left, upper, right and lower side, each turned to the left.
        strip, whole = (torch.stack(each, dim=1).flatten(0, 1) for each in (strips, wholes))
        known = self.known(torch.cat([self.around(surroundings), places], dim=1)).reshape(-1, _HIDDEN)
        outwards: Tensor = self.mixed(self.strip(strip.flatten(1)) + self.whole(whole.flatten(1)) + known)
        return outwards.reshape(-1, 4) * self.get_buffer("signs")


@dataclass(frozen=True, eq=False)
class Batch:
    """Holds the views of N boxes, the boxes themselves and those of their objects, `wanted`, in the image's pixels."""

    seed: int
    closeups: Tensor
    surroundings: Tensor
    places: Tensor
    boxes: Tensor
    wanted: Tensor


class RefinerTask(SecondTask[LabelledImage, Batch]):
    """Trains a refiner for the detector in `file` on labelled images."""

    kind, first, chunk = KIND, "detector", 32

    def __init__(
        self, data: DetectionData, file: Path, *, seed: int = 0, variation: Variation | None = None, side: int = SIDE
    ) -> None:
        self._first = FirstStage(file)
        network = self._first.network
        super().__init__(data, file, network.classes, seed, variation)
        self.side = side
        self._maps = maps_of(file)
        self._first.reveal(inner_names(network, self._maps))
        self._again = RefinerSettings(len(data.classes), side, LEAST, MOST)
        self._gather(max(1, min(_SHOWN, _ROWS // len(data.training))), seed)
        self._around = self._rows[1].shape[1]
        self.network = RefinerNetwork(len(data.classes), side, self._around)

    def description(self) -> dict[str, Any]:
        return {**super().description(), "side": self.side}

    def loss(self, batch: Batch, device: torch.device) -> dict[str, Tensor]:
        torch.manual_seed(batch.seed)  # of what is left out
        given = (batch.closeups, batch.surroundings.float(), batch.places)
        sides = self.network(*(each.to(device) for each in given)).float()
        boxes, wanted = batch.boxes.to(device), batch.wanted.to(device)
        extent = _twice((boxes[:, 2:] - boxes[:, :2]) * (1 + 2 * MARGIN) + 2 * PIXELS)
        overlap = complete_iou(boxes + sides * extent, wanted)
        apart = ((wanted - boxes) / extent - sides).abs().sum(dim=1)
        return {"overlap": (1 - overlap).mean(), "sides": 2 * apart.mean()}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        before, after = [], []
        for image in self.data.validation:
            pixels = image.read()
            truth = (image.boxes * _extent(pixels), image.classes, image.ignored)
            looked = self._first.look(pixels, *_SCORING)
            before.append(ScoredImage(*truth, looked.found))
            after.append(
                ScoredImage(*truth, look_again(partial(answered, network), pixels, looked, self._again, _SCORING[1]))
            )
        first, second = (score_detections(each, self.data.classes) for each in (before, after))
        return {
            "score": second.ap,
            "ap50": second.ap50,
            "ap": second.ap,
            "ap50_before": first.ap50,
            "ap_before": first.ap,
        }

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        own = {"side": self.side, "least_score": LEAST, "most_boxes": MOST, "maps": list(self._maps)}
        examples = {
            "closeups": torch.zeros(2, self.side, self.side, 3, dtype=torch.uint8),
            "surroundings": torch.zeros(2, self._around),
            "places": torch.zeros(2, numbers(len(self.data.classes))),
        }
        self._write(network, examples, own, facts, file)

    def _varied(self, rows: Columns, rng: np.random.Generator) -> Columns:
        seen, *others = rows
        return (recolored(seen.reshape(-1, self.side, 3), self.variation, rng).reshape(seen.shape), *others)

    def _batch(self, columns: list[Tensor], rngs: list[np.random.Generator]) -> Batch:
        return Batch(int(rngs[0].integers(1 << 31)), *columns)

    def _of_image(self, image: LabelledImage, most: int, rng: np.random.Generator) -> Columns:
        """A row for each of some boxes of an image that have an object: found ones, as they are and led astray, and
        true ones led astray."""
        pixels = image.read()
        size, truth = (pixels.shape[1], pixels.shape[0]), image.boxes * _extent(pixels)
        if rng.random() < self.variation.flip:
            pixels, truth = np.ascontiguousarray(pixels[:, ::-1]), mirror_image(truth, size[0])
        looked = self._first.look(pixels, *_SCORING)
        found = looked.found.select(looked.found.scores >= LEAST / 2)
        counted = np.flatnonzero(~image.ignored)
        boxes = np.concatenate([found.boxes, astray(found.boxes, _JITTER, rng), astray(truth[counted], _ASTRAY, rng)])
        sure = rng.uniform(0.2, 0.95, len(counted)).astype(np.float32)
        scores = np.concatenate([found.scores, found.scores, sure])
        classes = np.concatenate([found.classes, found.classes, image.classes[counted]])
        wanted, known = matched(boxes, classes, truth, image.classes, image.ignored)
        chosen = np.sort(rng.permutation(np.flatnonzero(known))[:most])
        boxes, scores, classes = boxes[chosen], scores[chosen], classes[chosen]
        window = windows(boxes)
        return (
            closeups(pixels, window, self.side),
            surroundings(looked.inner, window, looked.fit).astype(np.float16),
            places(boxes, scores, classes, len(self.data.classes), size),
            boxes,
            wanted[chosen],
        )


def maps_of(file: Path) -> list[str]:
    """The inner maps of a detector that its heads of strides 8 and 16 see, by their names in a file that is not in 8
    bits. Raises TrainingFileError where the file has no such heads."""
    import onnx

    strides = [int(stride) for stride in open_network(file, "detector").facts["strides"]]
    first: dict[int, str] = {}
    for node in onnx.load(file).graph.node:
        found = _HEAD.search(node.name) if node.op_type == "Conv" else None
        if found is not None:
            first.setdefault(int(found[1]), node.input[0].removesuffix(DEQUANTIZED))
    names = [first[k] for k, stride in enumerate(strides) if stride in _STRIDES and k in first]
    if not names:
        raise TrainingFileError(f"{file} has no heads of strides {_STRIDES}; `dataflow train` wrote no such file")
    return names


def matched(
    boxes: NDArray[np.float32],
    classes: NDArray[np.int32],
    truth: NDArray[np.float32],
    true_classes: NDArray[np.int32],
    ignored: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The object's box (N, 4) of each box, and whether it has one.

    A box is of the object of its class that it overlaps most, if enough, and if that is not an ignored one.
    """
    wanted, best, known = boxes.copy(), np.full(len(boxes), _SAME, np.float32), np.zeros(len(boxes), np.bool_)
    for box, label, aside in zip(truth, true_classes, ignored, strict=True):
        overlap = np.where(classes == label, intersection_over_union(box, boxes), 0)
        better = overlap > best
        wanted[better], best[better], known[better] = box, overlap[better], not aside
    return wanted, known


def astray(boxes: NDArray[np.float32], deviation: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Boxes (N, 4) whose sides are moved at random by so large a share of their size."""
    extent = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    moved_boxes = boxes + rng.normal(0, deviation, boxes.shape) * extent
    low, high = np.minimum(moved_boxes[:, :2], moved_boxes[:, 2:]), np.maximum(moved_boxes[:, :2], moved_boxes[:, 2:])
    return np.concatenate([low, high], axis=1).astype(np.float32)


def mirror_image(boxes: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Boxes (N, 4) in the mirror image."""
    return np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1)


def _twice(values: Tensor) -> Tensor:
    return torch.cat([values, values], dim=1)


def _extent(pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.array([pixels.shape[1], pixels.shape[0]] * 2, np.float32)
