"""Training of the focus network on views of simulated worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.detection.custom.evaluation import ScoredImage, score_detections
from operators.detection.custom.loss import complete_iou
from operators.detection.focus.cells import MULTIPLE, STRIDE
from operators.detection.focus.model import KIND, found_in
from operators.detection.focus.network import UNIT, DeployedFocus, FocusNetwork, normalized
from operators.detection.focus.targets import NOTHING, UNKNOWN, targets
from operators.detection.focus.views import CLASSES, NONE, Views
from operators.training.export import export_areas

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

_SIDE = 96  # pixels of the part of a view that is learned at a time
_EMPTY = 0.15  # how much a cell counts that shows none of the things
_SURE = 2.0  # weight of what the cells are of, beside where it ends
_SCORING = (0.05, 0.5, 100)  # least score, overlap for suppression, most boxes
_LEAST_PIXELS = 60  # of a thing that counts when the network is scored


@dataclass(frozen=True, eq=False)
class Batch:
    """Pixels (N, S, S, 3), and of each cell the class (N, h, w), the sides (N, 4, h, w) and how much it counts."""

    pixels: Tensor
    labels: Tensor
    sides: Tensor
    weights: Tensor


class FocusTask:
    """Trains a FocusNetwork on views, and scores it on others by COCO's AP.

    Scores are to be the overlap of the box that a cell gives: Li et al., "Generalized focal loss", 2020.
    """

    kind = KIND

    def __init__(self, training: Views, validation: Views, *, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self._training, self._validation = training, validation
        self.focus = FocusNetwork(len(CLASSES))

    @property
    def network(self) -> nn.Module:
        return self.focus

    @property
    def samples(self) -> int:
        return len(self._training.images)

    def description(self) -> dict[str, Any]:
        return {"classes": list(CLASSES), "views": self.samples, "side": _SIDE}

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> Batch:
        pixels, owners = zip(*(self._part(k, rng) for k, rng in zip(samples, rngs, strict=True)), strict=True)
        each = [targets(own, self._training.classes[k]) for k, own in zip(samples, owners, strict=True)]
        labels, sides, weights = (torch.from_numpy(np.stack(part)) for part in zip(*each, strict=True))
        return Batch(torch.from_numpy(np.stack(pixels)), labels, sides, weights)

    def loss(self, batch: Batch, device: torch.device) -> dict[str, Tensor]:
        scores, sides = self.focus(normalized(batch.pixels.to(device)).contiguous(memory_format=torch.channels_last))
        labels, weights = batch.labels.to(device), batch.weights.to(device)
        at = (labels >= 0).nonzero(as_tuple=True)
        image, row, column = at
        middle = torch.stack([column, row, column, row], dim=1) * STRIDE + STRIDE / 2
        signs = torch.tensor([-1.0, -1, 1, 1], device=device)
        wanted, logs = batch.sides.to(device)[image, :, row, column], sides.float()[image, :, row, column]
        overlap = complete_iou(middle + signs * logs.exp() * UNIT, wanted)
        apart = functional.smooth_l1_loss(
            logs, (((wanted - middle) * signs).clamp(min=0.5) / UNIT).log(), beta=0.1, reduction="none"
        ).mean(dim=1)
        own = weights[at]
        total = own.sum().clamp(min=1)
        sure = torch.zeros_like(scores, dtype=torch.float32)
        sure[image, labels[at], row, column] = overlap.detach().clamp(0, 1)
        focal = functional.binary_cross_entropy_with_logits(scores.float(), sure, reduction="none")
        focal = focal * (sure - scores.float().sigmoid()).square()
        counts = torch.where(labels == NOTHING, torch.full_like(weights, _EMPTY), weights) * (labels != UNKNOWN)
        return {
            "classes": _SURE * (focal * counts[:, None]).sum() / total,
            "overlap": ((1 - overlap) * own).sum() / total,
            "sides": (apart * own).sum() / total,
        }

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        assert isinstance(network, FocusNetwork)
        deployed = DeployedFocus(network).eval()
        device = next(network.parameters()).device

        def answer(pixels: U8) -> tuple[F32, F32]:
            with torch.inference_mode():
                scores, sides = deployed(torch.from_numpy(pixels[None]).to(device))
            return scores[0].cpu().numpy(), sides[0].cpu().numpy()

        scored = []
        for pixels, owners, classes in zip(
            self._validation.images, self._validation.owners, self._validation.classes, strict=True
        ):
            whole = (0, 0, pixels.shape[1], pixels.shape[0])
            found = found_in(answer, pixels, [whole], *_SCORING)
            scored.append(ScoredImage(*_truth(owners, classes), found))
        score = score_detections(scored, CLASSES)
        return {"score": score.ap, "ap50": score.ap50, **{f"ap50_{name}": ap for name, ap in score.per_class.items()}}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        assert isinstance(network, FocusNetwork)
        described = {
            "kind": KIND,
            "architecture": "pyramid",
            "classes": list(CLASSES),
            "stride": STRIDE,
            "multiple": MULTIPLE,
            "training_views": self.samples,
            **facts,
        }
        pixels = torch.zeros(1, 4 * MULTIPLE, 6 * MULTIPLE, 3, dtype=torch.uint8)
        export_areas(DeployedFocus(network), pixels, ["scores", "sides"], described, file)

    def _part(self, k: int, rng: np.random.Generator) -> tuple[U8, U8]:
        """Returns a part of a view, from anywhere in it, mirrored at times and in other light, and its owners."""
        pixels, owners = self._training.images[k], self._training.owners[k]
        y, x = rng.integers(0, pixels.shape[0] + 1 - _SIDE, 2).tolist()
        pixels, owners = pixels[y : y + _SIDE, x : x + _SIDE], owners[y : y + _SIDE, x : x + _SIDE]
        if rng.random() < 0.5:
            pixels, owners = pixels[:, ::-1], owners[:, ::-1]
        return relit(pixels, rng), np.ascontiguousarray(owners)


def relit(pixels: U8, rng: np.random.Generator) -> U8:
    """Returns pixels (H, W, 3) with another contrast, other brightness by channel, and grain."""
    contrast = np.exp(rng.normal(0, 0.15))
    brightness = rng.normal(0, 8, 3)
    grain = rng.standard_normal(pixels.shape, np.float32) * np.float32(rng.uniform(0, 4))
    return np.asarray(np.clip((pixels - 115.0) * contrast + 115 + brightness + grain, 0, 255), np.uint8)


def _truth(owners: U8, classes: U8) -> tuple[F32, NDArray[np.int32], NDArray[np.bool_]]:
    """Returns boxes (N, 4), classes and which are too small to count, of the things that a view shows."""
    boxes, labels, ignored = [], [], []
    for k, of in enumerate(classes[classes != NONE].tolist()):
        rows, columns = np.nonzero(owners == k + 1)
        if len(rows):
            boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
            labels.append(of)
            ignored.append(len(rows) < _LEAST_PIXELS)
    return np.array(boxes, np.float32).reshape(-1, 4), np.array(labels, np.int32), np.array(ignored, bool)
