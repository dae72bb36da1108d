"""Seeds every random generator before a firing, so that a firing depends on nothing that ran before it."""

from __future__ import annotations

import random
import sys
from typing import Any

import numpy as np
import xxhash


def firing_seed(graph_seed: int, operator: str, stamp: int) -> int:
    """63 bits from (graph seed, operator, stamp); independent of grouping, machine and run."""
    return xxhash.xxh3_64_intdigest(f"{graph_seed}/{operator}/{stamp}".encode()) & (2**63 - 1)


def seed_generators(seed: int) -> np.random.Generator:
    """Seeds the generators of the libraries that are loaded; returns the operator's own generator."""
    random.seed(seed)
    np.random.seed(seed & 0xFFFFFFFF)
    modules: dict[str, Any] = sys.modules  # a library that is not loaded is not loaded for this
    if (torch := modules.get("torch")) is not None:
        torch.default_generator.manual_seed(seed)
    if (cv2 := modules.get("cv2")) is not None:
        cv2.setRNGSeed(seed & 0x7FFFFFFF)
    if (open3d := modules.get("open3d")) is not None:
        open3d.utility.random.seed(seed & 0x7FFFFFFF)
    return np.random.Generator(np.random.PCG64(seed))
