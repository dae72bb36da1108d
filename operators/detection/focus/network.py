"""The focus network: a small fully convolutional detector for parts of an image in their own resolution."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

UNIT = 16.0
"""Pixels; sides are learned as logarithms of how many of these they are away."""
_CHANNELS = (24, 48, 64, 64)
_HEAD = 32
_FARTHEST, _NEAREST = 3.2, -5.0  # logarithms of units


class FocusNetwork(nn.Module):
    """Images (N, 3, H, W) → of each cell of 2x2 pixels scores (N, C, H/2, W/2) before the sigmoid, and logarithms of
    how far from its middle the four sides are (N, 4, H/2, W/2), in units. H and W are multiples of MULTIPLE.

    A pyramid (Lin et al., "Feature pyramid networks", 2017) with its answers at the finest level alone; each cell says
    what it is part of and where that ends, as in Tian et al., "FCOS", 2019.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        first, second, third, fourth = _CHANNELS
        self.finest = nn.Sequential(_convolution(3, first, 6, 2), _convolution(first, first))
        self.down = nn.ModuleList(
            [
                nn.Sequential(_convolution(first, second, 3, 2), _Residual(second)),
                nn.Sequential(_convolution(second, third, 3, 2), _Residual(third)),
                nn.Sequential(_convolution(third, fourth, 3, 2), _Residual(fourth), _Residual(fourth)),
            ]
        )
        pairs = [(fourth, third), (third, second), (second, first)]
        self.lateral = nn.ModuleList([_convolution(inputs, outputs, 1) for inputs, outputs in pairs])
        self.joined = nn.ModuleList([_convolution(outputs, outputs) for _, outputs in pairs])
        self.head = _convolution(first, _HEAD)
        self.scores, self.sides = nn.Conv2d(_HEAD, classes, 1), nn.Conv2d(_HEAD, 4, 1)
        assert self.scores.bias is not None
        nn.init.constant_(self.scores.bias, -4.0)  # most cells show none of the things

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        levels = [self.finest(images)]
        for down in self.down:
            levels.append(down(levels[-1]))
        x = levels.pop()
        for lateral, joined in zip(self.lateral, self.joined, strict=True):
            x = joined(levels.pop() + functional.interpolate(lateral(x), scale_factor=2.0, mode="nearest"))
        x = self.head(x)
        return self.scores(x), self.sides(x).clamp(_NEAREST, _FARTHEST)


class DeployedFocus(nn.Module):
    """Pixels (1, H, W, 3) in bytes → scores (1, C, H/2, W/2) and pixels to the sides (1, 4, H/2, W/2)."""

    def __init__(self, network: FocusNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        scores, sides = self.network(normalized(pixels))
        return scores.sigmoid(), sides.exp() * UNIT


def normalized(pixels: Tensor) -> Tensor:
    """Pixels (N, H, W, 3) in bytes as the network's input (N, 3, H, W)."""
    return (pixels.permute(0, 3, 1, 2).float() / 255 - 0.45) * 4


class _Residual(nn.Module):
    """Block of He et al., "Deep residual learning for image recognition", 2016."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        plain = nn.Conv2d(channels, channels, 3, 1, 1, bias=False)
        self.body = nn.Sequential(_convolution(channels, channels), plain, nn.BatchNorm2d(channels))

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.body(x))


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Module:
    plain = nn.Conv2d(inputs, outputs, size, stride, (size - 1) // 2, bias=False)
    return nn.Sequential(plain, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))
