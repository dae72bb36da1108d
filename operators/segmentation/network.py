"""The segmenter: MobileNetV2 and a light decoder that climbs back to half the input's resolution."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from operators.training.backbone import ConvNorm, MobileNetV2, SeparableConv

_LEVELS = ((16, 64), (8, 48), (4, 32), (2, 24))
"""(stride, channels) on the way back."""


class SegmentationNetwork(nn.Module):
    """Images (N, 3, H, W) in [0, 1] → class scores (N, C, ⌈H / 2⌉, ⌈W / 2⌉) before the softmax.

    The deepest map is weighed by the scene as a whole, as in LR-ASPP (Howard et al. 2019), then enlarged and merged
    with finer maps step by step, since a mug is a few pixels wide.
    """

    def __init__(self, classes: int, width: float = 1.0) -> None:
        super().__init__()
        self.backbone = MobileNetV2(width)
        deepest = self.backbone.channels[32]
        self.context = ConvNorm(deepest, 96, 1)
        self.gate = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Conv2d(deepest, 96, 1), nn.Sigmoid())
        self.lateral = nn.ModuleList(ConvNorm(self.backbone.channels[s], c, 1) for s, c in _LEVELS)
        inputs = [96, *(c for _, c in _LEVELS)]
        self.merge = nn.ModuleList(
            nn.Sequential(SeparableConv(inputs[i] + c, c), SeparableConv(c, c)) for i, (_, c) in enumerate(_LEVELS)
        )
        self.head = nn.Conv2d(_LEVELS[-1][1], classes, 1)

    def forward(self, images: Tensor) -> Tensor:
        maps = self.backbone(images)
        x = self.context(maps[32]) * self.gate(maps[32])
        for (stride, _), lateral, merge in zip(_LEVELS, self.lateral, self.merge, strict=True):
            fine = lateral(maps[stride])
            x = functional.interpolate(x, size=fine.shape[2:], mode="bilinear", align_corners=False)
            x = merge(torch.cat([x, fine], dim=1))
        scores: Tensor = self.head(x)
        return scores


class DeployedSegmenter(nn.Module):
    """Images (1, 3, H, W) → class (1, H, W) int32 and its probability (1, H, W): what the network file computes."""

    def __init__(self, network: SegmentationNetwork, size: Sequence[int]) -> None:
        super().__init__()
        self.network, self.size = network, tuple(size)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        scores = functional.interpolate(self.network(images), size=self.size, mode="bilinear", align_corners=False)
        best, label = scores.max(dim=1)
        confidence = 1 / (scores - best[:, None]).exp().sum(dim=1)
        return label.to(torch.int32), confidence
