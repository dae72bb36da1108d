"""The activity network: a recurrent network of two LSTM layers over feature vectors, one step at a time."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LAYERS = 2


class ActivityNetwork(nn.Module):
    """Feature vectors (B, T, F) → scores (B, T, C) of activities.

    Method: Hochreiter and Schmidhuber, "Long short-term memory", 1997.
    """

    def __init__(self, features: int, classes: int, width: int = 96) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        self.mean: Tensor
        self.scale: Tensor
        self.width = width
        self.enter = nn.Sequential(nn.Linear(features, width), nn.ReLU(), nn.Dropout(0.1))
        self.lstm = nn.LSTM(width, width, LAYERS, batch_first=True, dropout=0.2)
        self.leave = nn.Sequential(nn.Dropout(0.2), nn.Linear(width, classes))

    def forward(self, features: Tensor) -> Tensor:
        entered = self.enter((features - self.mean) / self.scale)
        passed, _ = self.lstm(entered)
        return torch.as_tensor(self.leave(passed))


class ActivityStep(nn.Module):
    """One step of several agents: features (N, F) and states (L, N, W) → probabilities (N, C) and next states."""

    def __init__(self, network: ActivityNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, hidden: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        network = self.network
        entered = network.enter((features[:, None] - network.mean) / network.scale)
        passed, (hidden, cell) = network.lstm(entered, (hidden, cell))
        return network.leave(passed[:, 0]).softmax(dim=1), hidden, cell
