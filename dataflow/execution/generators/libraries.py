"""Seeds the generators of loaded libraries that have separate ones."""

from __future__ import annotations

import sys
from typing import Any, SupportsInt

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
