"""Seeds every random generator before a call of an operator, so that the call depends on nothing that ran before it."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import xxhash

from dataflow.firing.lazy_random import seed_lazily

VERSION: Final = 2
"""The scheme by which calls are seeded; recordings name it, and re-execution follows the one they name.

1: `setup()`, `process()` and `finish()` are seeded. `on_reset()`, `on_parameter()`, `snapshot()`, `restore()` and
   `summary()` go on with what the call before has left. Recordings that name no version are of this one.
2: each of these is seeded too, from what it is, its incarnation and its stamp.
"""

FACT: Final = "seeding"
"""The name of the version among a recording's facts about its run."""


def version_of(run_facts: Mapping[str, str]) -> int:
    """The version by which a recorded run was seeded. Raises ValueError for one that this code does not know."""
    version = int(run_facts.get(FACT, "1"))
    if not 1 <= version <= VERSION:
        raise ValueError(f"the run's generators were seeded by version {version}; this code knows 1 to {VERSION}")
    return version


def firing_seed(graph_seed: int, operator: str, stamp: int) -> int:
    """63 bits from (graph seed, operator, stamp); independent of grouping, machine and run."""
    return xxhash.xxh3_64_intdigest(f"{graph_seed}/{operator}/{stamp}".encode()) & (2**63 - 1)


def change_seed(graph_seed: int, operator: str, what: str, incarnation: int, stamp: int) -> int:
    """63 bits for a call that is no firing, such as `on_reset()`."""
    text = f"{graph_seed}/{operator}/{what}/{incarnation}/{stamp}"
    return xxhash.xxh3_64_intdigest(text.encode()) & (2**63 - 1)


def seed_generators(seed: int) -> None:
    """Seeds the global generators of Python, numpy and the libraries that are loaded."""
    seed_lazily(seed)
    np.random.seed(seed & 0xFFFFFFFF)
    modules: dict[str, Any] = sys.modules  # a library that is not loaded is not loaded for this
    if (torch := modules.get("torch")) is not None:
        torch.default_generator.manual_seed(seed)
    if (cv2 := modules.get("cv2")) is not None:
        cv2.setRNGSeed(seed & 0x7FFFFFFF)
    if (open3d := modules.get("open3d")) is not None:
        open3d.utility.random.seed(seed & 0x7FFFFFFF)
