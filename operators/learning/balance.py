"""Weights of the classes in a loss, where some are rare."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def class_weights(labels: NDArray[np.int64], classes: int) -> Tensor:
    """Returns weights (C,), 1 in the mean over the labels (N,): rare classes count more, but not by all they lack."""
    counts = np.bincount(labels, minlength=classes)
    weights = (counts.sum() / np.maximum(counts, 1)) ** 0.5
    return torch.from_numpy((weights / np.average(weights, weights=counts)).astype(np.float32))
