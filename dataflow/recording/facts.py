"""Facts of the machine and the software that a result may depend on, for a recording's metadata."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = (
    "eclipse-zenoh",
    "foxglove-schemas-protobuf",
    "gtsam",
    "lz4",
    "mcap",
    "msgpack",
    "numpy",
    "onnxruntime",
    "open3d",
    "opencv-python",
    "opencv-python-headless",
    "protobuf",
    "robot-dataflow",
    "scipy",
    "small-gicp",
    "torch",
    "torchvision",
    "xxhash",
    "zstandard",
)
"""Packages whose version can change what is computed or how it is stored."""

THREAD_VARIABLES = (
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "PYTHONHASHSEED",
    "VECLIB_MAXIMUM_THREADS",
)
"""Variables that fix thread counts and hash order."""

CPU_FEATURES = frozenset({"avx", "avx2", "avx512f", "avx512_vnni", "fma", "sse4_2", "asimd", "sve", "amx_tile", "f16c"})
"""Instruction sets that numeric libraries choose their kernels by."""


def machine_facts() -> dict[str, dict[str, str]]:
    """Metadata records `machine`, `packages` and `threads`, keys sorted; equal on an equal machine."""
    model, features = _cpu()
    machine = {
        "architecture": platform.machine(),
        "cpu": model,
        "cpu_features": " ".join(sorted(features & CPU_FEATURES)),
        "cores": str(os.cpu_count() or 0),
        "implementation": platform.python_implementation(),
        "libc": " ".join(platform.libc_ver()).strip(),
        "os": platform.platform(),
        "python": platform.python_version(),
        "usable_cores": str(_usable_cores()),
    }
    return {"machine": dict(sorted(machine.items())), "packages": _packages(), "threads": _threads()}


def _cpu() -> tuple[str, frozenset[str]]:
    """Model name and feature flags; what the system does not tell stays empty."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor(), frozenset()
    model, features = "", frozenset[str]()
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Model") and not model:
            model = value.strip()
        elif key.strip() in ("flags", "Features") and not features:
            features = frozenset(value.split())
    return model or platform.processor(), features


def _usable_cores() -> int:
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 0


def _packages() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _threads() -> dict[str, str]:
    return {name: os.environ[name] for name in THREAD_VARIABLES if name in os.environ}
