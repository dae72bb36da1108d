"""The network that decides which pixels of a block are of which of two classes."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from operators.segmentation.borders import BLOCK, GRAIN, SEEN

_HIDDEN, _LAST = 64, 48
_LEVELS = 64.0
_SURE = 3.0
"""A preference beyond which a class is sure."""


class BorderNetwork(nn.Module):
    """Blocks (`operators.segmentation.borders.Blocks`) → (N, 16), above 0 where a pixel is of the first class.

    Colours count from the mean of what is seen, since light changes them all alike.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        count = (SEEN // GRAIN) ** 2
        self.seen = nn.Linear(SEEN * SEEN * 3 + 3, _HIDDEN)
        self.preferred = nn.Linear(2 * count, _HIDDEN)
        self.first, self.second = nn.Embedding(classes, _HIDDEN), nn.Embedding(classes, _HIDDEN)
        self.mixed = nn.Sequential(nn.ReLU(), nn.Linear(_HIDDEN, _LAST), nn.ReLU(), nn.Linear(_LAST, BLOCK * BLOCK))
        for embedding in (self.first, self.second):
            nn.init.zeros_(embedding.weight)

    def forward(self, pixels: Tensor, preferences: Tensor, first: Tensor, second: Tensor) -> Tensor:
        seen = pixels.float().flatten(1, 2) / _LEVELS
        mean = seen.mean(dim=1)
        return self.decide(
            self.seen(torch.cat([(seen - mean[:, None]).flatten(1), mean], dim=1)), preferences, first, second
        )

    def decide(self, seen: Tensor, preferences: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """Goes on from the first layer's answer (N, H) to the pixels."""
        rough = (preferences / _SURE).flatten(1)
        x = seen + self.preferred(torch.cat([rough.clamp(-1, 1), rough / 4], dim=1))
        answer: Tensor = self.mixed(x + self.first(first) + self.second(second))
        return answer


class DeployedBorders(nn.Module):
    """Computes the same as the file does, the first layer in integers.

    That layer takes pixels of 8 bits as they are: taking off the mean is a part of its weights. These are rounded to 7
    bits, by output, so that no sum overflows on processors without VNNI instructions.
    """

    def __init__(self, network: BorderNetwork) -> None:
        super().__init__()
        self.network = network
        weight, values = network.seen.weight.detach(), SEEN * SEEN
        apart, together = weight[:, : 3 * values], weight[:, 3 * values :]
        colors = apart.reshape(-1, values, 3)
        folded = (colors - colors.mean(dim=1, keepdim=True) + together[:, None] / values).flatten(1) / _LEVELS
        step = folded.abs().amax(dim=1).clamp(min=1e-12) / 63
        self.register_buffer("whole", (folded / step[:, None]).round().t().contiguous())
        self.register_buffer("step", step)

    def forward(self, pixels: Tensor, preferences: Tensor, first: Tensor, second: Tensor) -> Tensor:
        sums = pixels.flatten(1).float() @ self.get_buffer("whole")
        seen = sums * self.get_buffer("step") + self.network.seen.bias
        return self.network.decide(seen, preferences, first, second)
