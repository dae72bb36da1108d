"""Training of the posture network on silhouettes of simulated people."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.balance import class_weights
from operators.learning.export import export_rows
from operators.recognition.posture.data import BODY, POSTURES, Postures
from operators.recognition.posture.recognizer import KIND
from operators.recognition.posture.silhouette import HALF, MIDDLE, SIDE
from operators.weights.network_file import SIMULATOR, TRAINED_ON

_CHANNELS = (24, 48, 96)
_HIDDEN = 128
F32 = NDArray[np.float32]
_LIMBS = 4.0  # weight of where the limbs are
_BATCH = 256


class PostureNetwork(nn.Module):
    """Silhouettes (N, 3, SIDE, SIDE) → scores (N, C) of activities, and where the limbs are (N, BODY).

    Limbs are learned beside the activities, since they show much more of each silhouette than one name does; in use
    they are left out. Residual blocks: He et al., "Deep residual learning for image recognition", 2016.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        first, second, third = _CHANNELS
        self.body = nn.Sequential(
            _halved(3, first),
            _halved(first, second),
            _Residual(second),
            _halved(second, third),
            _Residual(third),
            _halved(third, third),
            nn.Flatten(),
            nn.Dropout(0.2),
            nn.Linear(third * (SIDE // 16) ** 2, _HIDDEN),
            nn.ReLU(),
            nn.Dropout(0.2),
        )
        self.activity, self.limbs = nn.Linear(_HIDDEN, classes), nn.Linear(_HIDDEN, BODY)

    def forward(self, silhouettes: Tensor) -> tuple[Tensor, Tensor]:
        seen = self.body(silhouettes)
        return self.activity(seen), self.limbs(seen)


class DeployedPosture(nn.Module):
    """Silhouettes (N, 3, SIDE, SIDE) → probabilities (N, C): what the network file computes."""

    def __init__(self, network: PostureNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, silhouettes: Tensor) -> Tensor:
        scores, _ = self.network(silhouettes)
        return torch.as_tensor(scores.softmax(dim=1))


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(*_convolution(channels, channels), nn.ReLU(), *_convolution(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.body(x))


def _halved(inputs: int, outputs: int) -> nn.Module:
    """Half the resolution."""
    return nn.Sequential(*_convolution(inputs, outputs, 2), nn.ReLU())


def _convolution(inputs: int, outputs: int, stride: int = 1) -> tuple[nn.Module, nn.Module]:
    return nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs)


class PostureTask:
    """Trains a PostureNetwork on silhouettes, and scores it on others by the mean share that is right of each class."""

    kind = KIND

    def __init__(self, training: Postures, validation: Postures, *, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self._training, self._validation, self.samples = training, validation, len(training.activities)
        self.network = PostureNetwork(len(POSTURES))
        self._weights = class_weights(training.activities, len(POSTURES))

    def description(self) -> dict[str, Any]:
        return {"classes": list(POSTURES), "silhouettes": self.samples, "side": SIDE}

    def batch(self, samples: list[int], rngs: list[np.random.Generator]) -> tuple[Tensor, Tensor, Tensor]:
        shapes, bodies = zip(*(self._varied(k, rng) for k, rng in zip(samples, rngs, strict=True)), strict=True)
        activities = torch.from_numpy(self._training.activities[samples])
        return torch.from_numpy(np.stack(shapes)), torch.from_numpy(np.stack(bodies)), activities

    def loss(self, batch: tuple[Tensor, Tensor, Tensor], device: torch.device) -> dict[str, Tensor]:
        shapes, bodies, activities = (part.to(device) for part in batch)
        scores, limbs = self.network(shapes)
        entropy = functional.cross_entropy(scores.float(), activities, self._weights.to(device), label_smoothing=0.03)
        return {"entropy": entropy, "limbs": _LIMBS * functional.smooth_l1_loss(limbs.float(), bodies, beta=0.1)}

    def evaluate(self, network: nn.Module) -> dict[str, float]:
        """Scores by the mean over activities of the share that is right; `accuracy` is over silhouettes."""
        device, said = next(network.parameters()).device, []
        for begin in range(0, len(self._validation.activities), _BATCH):
            shapes = torch.from_numpy(self._validation.silhouettes[begin : begin + _BATCH]).float() / 127
            with torch.inference_mode():
                said.append(network(shapes.to(device))[0].argmax(dim=1).cpu().numpy())
        true, right = self._validation.activities, np.concatenate(said) == self._validation.activities
        shares = [float(right[true == k].mean()) for k in range(len(POSTURES)) if (true == k).any()]
        return {"score": float(np.mean(shares)), "accuracy": float(right.mean())}

    def export(self, network: nn.Module, facts: Mapping[str, Any], file: Path) -> None:
        assert isinstance(network, PostureNetwork)
        described = {
            "kind": KIND,
            "architecture": "residual cnn",
            "classes": list(POSTURES),
            "side": SIDE,
            "half": HALF,
            "middle": MIDDLE,
            "training_silhouettes": self.samples,
            TRAINED_ON: SIMULATOR,
            **facts,
        }
        example = {"silhouettes": torch.zeros(2, 3, SIDE, SIDE)}
        export_rows(DeployedPosture(network), example, ["probabilities"], described, file)

    def _varied(self, k: int, rng: np.random.Generator) -> tuple[F32, F32]:
        shape = self._training.silhouettes[k].astype(np.float32) / 127
        body = self._training.bodies[k].copy()
        if rng.random() < 0.5:
            shape, body = mirrored(shape, body)
        return varied(shape, rng), body


def mirrored(shape: F32, body: F32) -> tuple[F32, F32]:
    """Returns a silhouette and its body with left and right exchanged."""
    joints = body[:15].reshape(5, 3) * np.array([-1, 1, 1], np.float32)
    found = body.copy()
    found[:15] = joints[[1, 0, 3, 2, 4]].ravel()  # hands, feet, pelvis
    found[16] = -body[16]
    return np.ascontiguousarray(shape[:, :, ::-1]), found


def varied(shape: F32, rng: np.random.Generator) -> F32:
    """Returns a silhouette a little astray, at times cut off, covered in part, bare of what is around, or sparse."""
    found = np.roll(shape, (int(rng.integers(-1, 2)), int(rng.integers(-2, 3))), (1, 2))
    if rng.random() < 0.25:
        side, lost = int(rng.integers(4)), int(rng.integers(4, 22))
        rows = slice(None, lost) if side % 2 else slice(-lost, None)
        found[(slice(None), rows) if side < 2 else (slice(None), slice(None), rows)] = 0
    if rng.random() < 0.2:
        found[2] = 0
    if rng.random() < 0.25:
        row, column, half = int(rng.integers(SIDE)), int(rng.integers(SIDE)), int(rng.integers(3, 9))
        found[:2, max(0, row - half) : row + half, max(0, column - half) : column + half] = 0
    found[1] = (found[1] + np.float32(rng.normal(0, 0.08))) * found[0]
    sparse = float(rng.random()) ** 3 * 0.35
    return np.asarray(found * (rng.random((SIDE, SIDE)) >= sparse), np.float32)
