"""The network of a refiner: a close-up, its surroundings and what is known of its box → how its sides move."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from operators.detection.custom.closeup import numbers

_HIDDEN, _LAST, _AROUND = 160, 64, 128
_ALONG, _WHOLE = 12, 12
"""Samples along a side, and along the sides of what is seen of the whole."""
_FORGOTTEN = 0.25
"""Share of values that training leaves out, so that no object is learned by heart."""


class RefinerNetwork(nn.Module):
    """Close-ups (N, S, S, 3) uint8, surroundings (N, A) and places (N, F) → sides (N, 4), shares of the window.

    Every side is seen as if it were the left one: the half of the close-up beside it, fine across the side and coarse
    along it, and the whole, coarse. So one set of weights learns from all four sides. The surroundings tell them apart.
    """

    def __init__(self, classes: int, side: int, around: int) -> None:
        super().__init__()
        if side % 12:
            raise ValueError(f"a close-up's side must be a multiple of 12, got {side}")
        self.side = side
        known = numbers(classes)
        strip, whole = side // 2 * _ALONG * 3, _WHOLE * _WHOLE * 3
        self.strip, self.whole = nn.Linear(strip, _HIDDEN), nn.Linear(whole, _HIDDEN)
        self.around = nn.Sequential(
            nn.Dropout(_FORGOTTEN), nn.Linear(around, _AROUND), nn.ReLU(), nn.Dropout(_FORGOTTEN)
        )
        self.known = nn.Linear(_AROUND + known, 4 * _HIDDEN)  # of each side for itself: a foot is not a head
        self.mixed = nn.Sequential(
            nn.ReLU(),
            nn.Dropout(_FORGOTTEN),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(),
            nn.Dropout(_FORGOTTEN),
            nn.Linear(_HIDDEN, _LAST),
            nn.ReLU(),
            nn.Linear(_LAST, 1),
        )
        last = self.mixed[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)  # begins by leaving boxes where they are
        nn.init.zeros_(last.bias)
        self.register_buffer("signs", torch.tensor([-1.0, -1.0, 1.0, 1.0]), persistent=False)

    def forward(self, closeups: Tensor, surroundings: Tensor, places: Tensor) -> Tensor:
        x = closeups.permute(0, 3, 1, 2).float() / 64
        x = x - x.mean(dim=(2, 3), keepdim=True)
        half, along = self.side // 2, self.side // _ALONG
        across = functional.avg_pool2d(x, (along, 1)), functional.avg_pool2d(x, (1, along)).transpose(2, 3)
        strips = [each[..., :half] for each in across] + [each.flip(3)[..., :half] for each in across]
        small = functional.avg_pool2d(x, self.side // _WHOLE)
        wholes = [small, small.transpose(2, 3), small.flip(3), small.flip(2).transpose(2, 3)]
        # Left, upper, right and lower side, each turned to the left.
        strip, whole = (torch.stack(each, dim=1).flatten(0, 1) for each in (strips, wholes))
        known = self.known(torch.cat([self.around(surroundings), places], dim=1)).reshape(-1, _HIDDEN)
        outwards: Tensor = self.mixed(self.strip(strip.flatten(1)) + self.whole(whole.flatten(1)) + known)
        return outwards.reshape(-1, 4) * self.get_buffer("signs")
