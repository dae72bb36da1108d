"""The reclassifier's network: a small convolutional network over close-ups."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_CHANNELS = (16, 32, 48, 64)
_GRID = 2  # side of what the last map is averaged to


class ReclassifierNetwork(nn.Module):
    """Pixels (N, SIDE, SIDE, 3) in bytes → scores (N, C) before the softmax."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        first, second, third, fourth = _CHANNELS
        self.body = nn.Sequential(
            _convolution(3, first),
            _convolution(first, second, 2),
            _convolution(second, second),
            _convolution(second, third, 2),
            _convolution(third, third),
            _convolution(third, fourth, 2),
            nn.AdaptiveAvgPool2d(_GRID),
            nn.Flatten(),
            nn.Dropout(0.3),
            nn.Linear(fourth * _GRID**2, classes),
        )

    def forward(self, closeups: Tensor) -> Tensor:
        return torch.as_tensor(self.body((closeups.permute(0, 3, 1, 2).float() / 255 - 0.45) * 4))


class DeployedReclassifier(nn.Module):
    """Pixels (N, SIDE, SIDE, 3) in bytes → probabilities (N, C): what the network file computes."""

    def __init__(self, network: ReclassifierNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, closeups: Tensor) -> Tensor:
        return torch.as_tensor(self.network(closeups).softmax(dim=1))


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Module:
    plain = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(plain, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
