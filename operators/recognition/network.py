"""The recognition network: four convolution blocks and two linear layers, or residual blocks in their place."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from operators.learning.backbone import IMAGENET_MEAN, IMAGENET_STD

Architecture = Literal["plain", "residual"]
FEATURES = 256
"""Width of the hidden layer, whose values describe an image."""
_CHANNELS = (32, 64, 128, 256)
_GRID = 2
"""Side of what the last block's map is averaged to: where in the image something lies still counts a little."""


class ClassifierNetwork(nn.Module):
    """Images (N, 3, H, W) in [0, 1], multiples of 32 → class scores (N, C) before the softmax."""

    def __init__(self, classes: int, architecture: Architecture = "plain") -> None:
        super().__init__()
        widths = (3, *_CHANNELS)
        block = _plain if architecture == "plain" else _Residual
        self.blocks = nn.Sequential(*(block(a, b) for a, b in pairwise(widths)))
        self.pool = nn.AdaptiveAvgPool2d(_GRID)
        self.hidden = nn.Linear(_CHANNELS[-1] * _GRID**2, FEATURES)
        self.drop = nn.Dropout(0.3)
        self.head = nn.Linear(FEATURES, classes)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def features(self, images: Tensor) -> Tensor:
        """Returns the hidden layer (N, 256) after its activation."""
        seen = (images - self.mean) / self.deviation  # type: ignore[operator]
        return torch.relu(self.hidden(self.pool(self.blocks(seen)).flatten(1)))

    def forward(self, images: Tensor) -> Tensor:
        scores: Tensor = self.head(self.drop(self.features(images)))
        return scores


class DeployedClassifier(nn.Module):
    """Images (1, 3, H, W) → probabilities (1, C) and features (1, 256): what the network file computes."""

    def __init__(self, network: ClassifierNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        features = self.network.features(images)
        return self.network.head(features).softmax(dim=1), features


def _plain(inputs: int, outputs: int) -> nn.Module:
    """Two 3x3 convolutions, each normalised and rectified; then half the resolution."""
    return nn.Sequential(*_convolution(inputs, outputs), *_convolution(outputs, outputs), nn.MaxPool2d(2))


class _Residual(nn.Module):
    """As a plain block, around which what comes in is carried (He et al. 2016)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        first, second = _convolution(inputs, outputs), _convolution(outputs, outputs)
        self.body = nn.Sequential(*first, *second[:-1])
        self.skip = nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs))
        self.pool = nn.MaxPool2d(2)

    def forward(self, x: Tensor) -> Tensor:
        pooled: Tensor = self.pool(torch.relu(self.body(x) + self.skip(x)))
        return pooled


def _convolution(inputs: int, outputs: int) -> list[nn.Module]:
    return [nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)]
