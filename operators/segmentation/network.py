"""The segmenter: a backbone and a light decoder that climbs back to half the input's resolution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from operators.learning.backbone import Backbone, ConvNorm, MobileNetV2, SeparableConv

_LEVELS = ((16, 64, 64), (8, 48, 48), (4, 32, 24), (2, 16, 24))
"""(stride, channels taken from the backbone, channels after merging) on the way back."""
_DETAIL = 32
WIDEST = 0.06
"""The largest step of scores in 8 bits: 255 are a factor of four million between the probabilities of two classes."""


class ClassDecoder(nn.Module):
    """Feature maps by stride → class scores (N, C, H, W) at stride 2, before the softmax.

    The deepest map is weighed by the scene as a whole, as in LR-ASPP (Howard et al. 2019), then enlarged and merged
    with finer maps step by step, since a mug is a few pixels wide. For detail finer than its cells, the map of stride 4
    has four answers a cell, where arithmetic is cheaper than at stride 2. A score is for the upper left pixel of
    its cell.
    """

    def __init__(self, classes: int, inputs: Mapping[int, int]) -> None:
        super().__init__()
        deepest = inputs[32]
        self.context = ConvNorm(deepest, 96, 1)
        self.gate = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Conv2d(deepest, 96, 1), nn.Sigmoid())
        self.lateral = nn.ModuleList(ConvNorm(inputs[s], c, 1) for s, c, _ in _LEVELS)
        coarser = [96, *(c for _, _, c in _LEVELS)]
        self.merge = nn.ModuleList(
            # At half the resolution, reading and writing cost more than arithmetic: one full convolution.
            nn.Sequential(SeparableConv(above + fine, c), SeparableConv(c, c)) if s > 2 else ConvNorm(above + fine, c)
            for above, (s, fine, c) in zip(coarser, _LEVELS, strict=False)
        )
        self.head = nn.Conv2d(coarser[-1], classes, 1)
        _, fine, merged = _LEVELS[-2]
        last = nn.Conv2d(_DETAIL, 4 * classes, 1)
        nn.init.zeros_(last.weight)
        assert last.bias is not None
        nn.init.zeros_(last.bias)
        self.detail = nn.Sequential(
            ConvNorm(fine + merged, _DETAIL), ConvNorm(_DETAIL, _DETAIL), last, nn.PixelShuffle(2)
        )

    def forward(self, maps: Mapping[int, Tensor]) -> Tensor:
        x = self.context(maps[32]) * self.gate(maps[32])
        detail: Tensor | None = None
        for (stride, _, _), lateral, merge in zip(_LEVELS, self.lateral, self.merge, strict=True):
            fine = lateral(maps[stride])
            x = functional.interpolate(x, size=fine.shape[2:], mode="bilinear", align_corners=False)
            x = merge(torch.cat([x, fine], dim=1))
            if stride == 4:
                detail = self.detail(torch.cat([x, fine], dim=1))
        scores: Tensor = self.head(x)
        assert detail is not None
        return scores + detail[..., : scores.shape[2], : scores.shape[3]]


class SegmentationNetwork(nn.Module):
    """Images (N, 3, H, W) in [0, 1] → class scores (N, C, ⌈H / 2⌉, ⌈W / 2⌉) before the softmax.

    Without a `backbone` it is MobileNetV2 of this `width`.
    """

    def __init__(self, classes: int, width: float = 1.0, *, backbone: Backbone | None = None) -> None:
        super().__init__()
        self.backbone = MobileNetV2(width) if backbone is None else backbone
        self.decoder = ClassDecoder(classes, self.backbone.channels)

    def forward(self, images: Tensor) -> Tensor:
        scores: Tensor = self.decoder(self.backbone(images))
        return scores


class ScoringSegmenter(nn.Module):
    """Images (1, 3, H, W) → scores (1, C, H / 2, W / 2) uint8: what the network file computes.

    They count in steps of so much below 255, the best of their cell; what is too far below it is 0.
    """

    def __init__(self, network: nn.Module, step: float) -> None:
        super().__init__()
        self.network, self.step = network, step

    def forward(self, images: Tensor) -> Tensor:
        scores = self.network(images)
        # No sum and no clipping, which `operators.training.quantization` would take for parts of the network.
        steps = (scores - scores.amax(dim=1, keepdim=True)) / self.step - (-255.0)
        return torch.maximum(steps, torch.zeros_like(steps[:, :1])).round().to(torch.uint8)


class DeployedSegmenter(nn.Module):
    """Images (1, 3, H, W) → class (1, H, W) int32 and its probability (1, H, W): the file of more than 32 classes.

    `size` is (H, W), both even. The scores are enlarged before a class is chosen, for smooth borders; the probability,
    which needs more arithmetic, is enlarged after.
    """

    def __init__(self, network: nn.Module, size: Sequence[int]) -> None:
        super().__init__()
        self.network, self.size = network, tuple(size)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        scores = self.network(images)
        best = 1 / (scores - scores.amax(dim=1, keepdim=True)).exp().sum(dim=1, keepdim=True)
        label = enlarged(scores, self.size).argmax(dim=1)
        return label.to(torch.int32), enlarged(best, self.size)[:, 0]


def enlarged(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Maps (N, C, H / 2, W / 2) at `size` (H, W): pixel (2i, 2j) takes the value of cell (i, j), others lie between."""
    height, width = size
    edged = functional.pad(maps, (0, 1, 0, 1), mode="replicate")
    wide = functional.interpolate(edged, size=(height + 1, width + 1), mode="bilinear", align_corners=True)
    return wide[..., :height, :width]
