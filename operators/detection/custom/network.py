"""The grid detector: a backbone, a feature pyramid, and per cell and anchor a box, an objectness and class scores."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.backbone import Backbone, MobileNetV2, SeparableConv

STRIDES = (8, 16, 32)
FINE_STRIDES = (4, *STRIDES)
"""For objects of less than ten pixels."""
ANCHORS_PER_CELL = 3


class GridHead(nn.Module):
    """Feature maps by stride → one map (N, A · (5 + C), H, W) for each of `strides`, by a feature pyramid.

    The meaning of the channels is in `operators.detection.custom.decode`.
    """

    def __init__(
        self, classes: int, inputs: Mapping[int, int], channels: int = 96, strides: Sequence[int] = STRIDES
    ) -> None:
        super().__init__()
        self.strides = tuple(strides)
        self.lateral = nn.ModuleList(nn.Conv2d(inputs[s], channels, 1) for s in strides)
        self.smooth = nn.ModuleList(SeparableConv(channels, channels) for _ in strides)
        outputs = ANCHORS_PER_CELL * (5 + classes)
        self.heads = nn.ModuleList(
            nn.Sequential(SeparableConv(channels, channels), nn.Conv2d(channels, outputs, 1)) for _ in strides
        )
        for head in self.heads:
            assert isinstance(head, nn.Sequential)
            _start_rare(head[-1], classes)

    def forward(self, maps: Mapping[int, Tensor]) -> tuple[Tensor, ...]:
        merged: list[Tensor] = []
        for stride, lateral, smooth in reversed(list(zip(self.strides, self.lateral, self.smooth, strict=True))):
            level = lateral(maps[stride])
            if merged:
                level = level + functional.interpolate(merged[-1], size=level.shape[2:], mode="nearest")
            merged.append(smooth(level))
        return tuple(head(level) for head, level in zip(self.heads, reversed(merged), strict=True))


class GridDetector(nn.Module):
    """Images (N, 3, H, W) in [0, 1] → one map (N, A · (5 + C), ⌈H / s⌉, ⌈W / s⌉) for each stride s.

    H and W must be multiples of 16. Without a `backbone` it is MobileNetV2 of this `width`.
    """

    def __init__(
        self,
        classes: int,
        width: float = 1.0,
        channels: int = 96,
        *,
        backbone: Backbone | None = None,
        strides: Sequence[int] = STRIDES,
    ) -> None:
        super().__init__()
        self.classes = classes
        self.backbone = MobileNetV2(width) if backbone is None else backbone
        self.head = GridHead(classes, self.backbone.channels, channels, strides)

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        found: tuple[Tensor, ...] = self.head(self.backbone(images))
        return found


def _start_rare(layer: nn.Module, classes: int) -> None:
    """Biases such that a cell begins by expecting an object with 1 %: else the empty cells drown the first steps."""
    assert isinstance(layer, nn.Conv2d)
    assert layer.bias is not None
    nn.init.normal_(layer.weight, std=0.01)
    with torch.no_grad():
        bias = layer.bias.view(ANCHORS_PER_CELL, 5 + classes)
        bias[:, :4] = 0
        bias[:, 4] = math.log(0.01 / 0.99)
        bias[:, 5:] = math.log(0.6 / max(classes - 0.4, 0.6))
