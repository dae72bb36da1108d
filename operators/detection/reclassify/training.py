"""Training of the reclassifier on the things in views of simulated worlds."""

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

from operators.detection.focus.training import relit
from operators.detection.focus.views import CLASSES, NONE, Views
from operators.detection.reclassify.closeups import AROUND, SIDE, closeups
from operators.detection.reclassify.model import KIND
from operators.detection.reclassify.network import DeployedReclassifier, ReclassifierNetwork
from operators.training.balance import class_weights
from operators.training.export import export_rows

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

_SIDES = (5, 80)  # pixels of the longer side of things that are learned
_SHOWN = 0.25  # share of its box that a thing fills at least
_ASTRAY, _SCALED = 0.06, 0.08  # standard deviations of a box's middle, in sides, and of the logarithm of its size
_OTHERS = 3  # one of so many of the class that there is most of is learned
_BATCH = 512


class ReclassifierTask:
    """Trains a ReclassifierNetwork on the things in views, and scores it by the mean share right of each class."""

    kind = KIND

    def __init__(self, training: Views, validation: Views, *, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self._training, self._rows = training, _thinned(things_of(training))
        rows = things_of(validation)
        pixels = [closeups(validation.images[int(row[0])], row[None, 2:]) for row in rows]
        self._seen, self._true = np.concatenate(pixels), rows[:, 1].astype(np.int64)
        self.reclassifier = ReclassifierNetwork(len(CLASSES))
        self._weights = class_weights(self._rows[:, 1].astype(np.int64), len(CLASSES))

    @property
    def network(self) -> nn.Module:
        return self.reclassifier

    @property
    def samples(self) -> int:
        return len(self._rows)

    def description(self) -> dict[str, Any]:
        return {"classes": list(CLASSES), "closeups": self.samples, "side": SIDE}

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor]:
        seen = np.stack([self._varied(self._rows[k], rng) for k, rng in zip(samples, rngs, strict=True)])
        return torch.from_numpy(seen), torch.from_numpy(self._rows[samples, 1].astype(np.int64))

    def loss(self, batch: tuple[Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        seen, classes = (part.to(device) for part in batch)
        scores = self.reclassifier(seen).float()
        return {"entropy": functional.cross_entropy(scores, classes, self._weights.to(device), label_smoothing=0.03)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        """Scores by the mean over classes of the share that is right; `accuracy` is over things."""
        device, said = next(network.parameters()).device, []
        for begin in range(0, len(self._seen), _BATCH):
            with torch.inference_mode():
                seen = torch.from_numpy(self._seen[begin : begin + _BATCH]).to(device)
                said.append(network(seen).argmax(dim=1).cpu().numpy())
        right = np.concatenate(said) == self._true
        shares = {name: right[self._true == k] for k, name in enumerate(CLASSES) if (self._true == k).any()}
        found = {name: float(share.mean()) for name, share in shares.items()}
        return {"score": float(np.mean(list(found.values()))), "accuracy": float(right.mean()), **found}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        assert isinstance(network, ReclassifierNetwork)
        described = {
            "kind": KIND,
            "architecture": "plain cnn",
            "classes": list(CLASSES),
            "side": SIDE,
            "around": AROUND,
            "training_closeups": self.samples,
            **facts,
        }
        example = {"closeups": torch.zeros(2, SIDE, SIDE, 3, dtype=torch.uint8)}
        export_rows(DeployedReclassifier(network), example, ["probabilities"], described, file)

    def _varied(self, row: F32, rng: np.random.Generator) -> U8:
        """Returns a close-up of a thing by a box that is a little astray, mirrored at times and in other light."""
        box = row[2:]
        longer = float((box[2:] - box[:2]).max())
        half = (box[2:] - box[:2]) / 2 * np.exp(rng.normal(0, _SCALED))
        middle = (box[:2] + box[2:]) / 2 + rng.normal(0, _ASTRAY * longer, 2)
        moved = np.concatenate([middle - half, middle + half]).astype(np.float32)
        seen = closeups(self._training.images[int(row[0])], moved[None])[0]
        return relit(seen[:, ::-1] if rng.random() < 0.5 else seen, rng)


def things_of(views: Views) -> F32:
    """Returns which view each thing is in, its class and its box (N, 6), of things that are plainly seen."""
    rows = []
    for k, (owners, classes) in enumerate(zip(views.owners, views.classes, strict=True)):
        for j, of in enumerate(classes[classes != NONE].tolist()):
            own = owners == j + 1
            x, y, width, height = cv2.boundingRect(own.astype(np.uint8))
            if _SIDES[0] <= max(width, height) <= _SIDES[1] and own.sum() >= _SHOWN * width * height:
                rows.append((k, of, x, y, x + width, y + height))
    return np.array(rows, np.float32).reshape(-1, 6)


def _thinned(rows: F32) -> F32:
    """Returns the rows without most of those of the class that there is most of."""
    most = np.bincount(rows[:, 1].astype(np.int64)).argmax()
    common = np.flatnonzero(rows[:, 1] == most)
    return np.delete(rows, np.setdiff1d(common, common[::_OTHERS]), axis=0)
