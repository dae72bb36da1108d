"""The posture network: a small convolutional network over silhouettes of people."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from operators.recognition.posture.data import BODY
from operators.recognition.posture.silhouette import SIDE

_CHANNELS = (24, 48, 96)
_HIDDEN = 128


class PostureNetwork(nn.Module):
    """Silhouettes (N, 3, SIDE, SIDE) → scores (N, C) of activities, and where the limbs are (N, BODY).

    Limbs are learned beside the activities, since they tell much more of each silhouette than one name does; in use
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
