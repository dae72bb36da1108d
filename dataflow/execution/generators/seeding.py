"""Seeds every random generator before a call of an operator, so that the call depends on nothing that ran before it."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from threading import get_ident
from typing import Any, Final, SupportsInt

import xxhash

from dataflow.execution.generators import lazy_numpy, lazy_random
from dataflow.execution.generators.loading import LOADS


def seed_libraries(seed: SupportsInt) -> None:
    """Seeds the libraries that are loaded; one that is just being loaded by another thread is left out."""
    modules = sys.modules
    if "torch" in modules:
        _seed_torch(modules.get("torch"), seed)
    if "cv2" in modules:
        _seed_cv2(modules.get("cv2"), seed)
    if "open3d" in modules:
        _seed_open3d(modules.get("open3d"), seed)


def _seed_torch(torch: Any, seed: SupportsInt) -> None:
    if (generator := getattr(torch, "default_generator", None)) is not None:
        generator.manual_seed(int(seed))
    if (cuda := getattr(torch, "cuda", None)) is None or not hasattr(torch, "version") or torch.version.cuda is None:
        return
    if cuda.is_initialized():
        _seed_cuda(cuda, seed)
    elif not hasattr(cuda, _FOLLOWED):
        setattr(cuda, _FOLLOWED, True)
        cuda._lazy_call(lambda: _seed_initialised(cuda))


_FOLLOWED = "_dataflow_seeds"


def _seed_initialised(cuda: Any) -> None:
    """Seeds the generators of the GPUs when CUDA is initialised within a call."""
    if LOADS.seed is not None:
        _seed_cuda(cuda, LOADS.seed)


def _seed_cuda(cuda: Any, seed: SupportsInt) -> None:
    for generator in cuda.default_generators:
        generator.manual_seed(int(seed))


def _seed_cv2(cv2: Any, seed: SupportsInt) -> None:
    if (set_seed := getattr(cv2, "setRNGSeed", None)) is not None:
        set_seed(int(seed) & 0x7FFFFFFF)


def _seed_open3d(open3d: Any, seed: SupportsInt) -> None:
    if (utility := getattr(open3d, "utility", None)) is not None:
        utility.random.seed(int(seed) & 0x7FFFFFFF)


VERSION: Final = 3
"""The scheme by which calls are seeded; recordings name it, and re-execution follows the one they name.

1: `setup()`, `process()` and `finish()` are seeded. `on_reset()`, `on_parameter()`, `snapshot()`, `restore()` and
   `summary()` go on with what the call before has left. Recordings that name no version are of this one.
2: each of these is seeded too, from what it is, its incarnation and its stamp.
3: a library that a call loads is seeded in that call, and so are torch's generators on GPUs that it initialises; what
   modules draw while they are loaded is taken back (`dataflow.execution.generators.loading`).
"""

FACT: Final = "seeding"
"""The name of the version among a recording's facts about its run."""


def version_of(run_facts: Mapping[str, str]) -> int:
    """The version by which a recorded run was seeded. Raises ValueError for one that this code does not know."""
    version = int(run_facts.get(FACT, "1"))
    if not 1 <= version <= VERSION:
        raise ValueError(f"the run's generators were seeded by version {version}; this code supports 1 to {VERSION}")
    return version


def firing_seed(graph_seed: int, operator: str, stamp: int) -> int:
    """63 bits from (graph seed, operator, stamp); independent of grouping, machine and run."""
    return int(FiringSeed((f"{graph_seed}/{operator}/", stamp)))


def change_seed(graph_seed: int, operator: str, what: str, incarnation: int, stamp: int) -> int:
    """63 bits for a call that is no firing, such as `on_reset()`."""
    text = f"{graph_seed}/{operator}/{what}/{incarnation}/{stamp}"
    return xxhash.xxh3_64_intdigest(text.encode()) & (2**63 - 1)


class FiringSeed(tuple[str, int]):
    """The seed of a firing, made of (`GRAPH_SEED/OPERATOR/`, stamp) when it is converted to an integer. A tuple, which
    is made without a call of Python: there is one for every firing, and few draw."""

    __slots__ = ()

    def __int__(self) -> int:
        of, stamp = self
        return xxhash.xxh3_64_intdigest(f"{of}{stamp}".encode()) & (2**63 - 1)


def seed_generators(seed: SupportsInt, version: int = VERSION) -> None:
    """Seeds the global generators of Python, numpy and the libraries that are loaded, for a call that begins.

    Those of Python and numpy are seeded when something draws from them, those of a library that the call loads when it
    is loaded. `LOADS.seed = None` ends the call.
    """
    lazy_random.seed_lazily(seed)
    lazy_numpy.seed_lazily(seed)
    seed_libraries(seed)
    if version >= 3:
        LOADS.seed, LOADS.thread = seed, get_ident()


LOADS.follow(seed_libraries)
