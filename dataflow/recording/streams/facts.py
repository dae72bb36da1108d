"""Facts of the machine and the software that a result may depend on, for a recording's metadata."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = (
    "eclipse-zenoh foxglove-schemas-protobuf gtsam kiss-icp lz4 mcap msgpack numpy onnxruntime onnxruntime-gpu open3d "
    "opencv-python opencv-python-headless protobuf robot-dataflow scipy small-gicp torch torchvision xxhash zstandard"
)
PACKAGES = tuple(_PACKAGES.split())
"""Packages whose version can change what is computed or how it is stored."""

_THREADS = (
    "BLIS_NUM_THREADS MKL_NUM_THREADS NUMEXPR_NUM_THREADS OMP_NUM_THREADS OPENBLAS_NUM_THREADS PYTHONHASHSEED "
    "TBB_NUM_THREADS VECLIB_MAXIMUM_THREADS"
)
THREAD_VARIABLES = tuple(_THREADS.split())
"""Variables that fix thread counts and hash order."""

_KERNELS = (
    "CUBLAS_WORKSPACE_CONFIG CUDA_VISIBLE_DEVICES MKL_CBWR MKL_ENABLE_INSTRUCTIONS NPY_DISABLE_CPU_FEATURES "
    "NVIDIA_TF32_OVERRIDE OPENBLAS_CORETYPE OPENCV_CPU_DISABLE"
)
KERNEL_VARIABLES = tuple(_KERNELS.split())
"""Variables by which the numerical libraries choose other code for the same computation."""

_FEATURES = (
    "amx_bf16 amx_int8 amx_tile asimd asimddp avx avx2 avx512_bf16 avx512_fp16 avx512_vnni avx512bw avx512dq avx512f "
    "avx512vl avx_vnni bf16 f16c fma fphp i8mm sse4_1 sse4_2 sve sve2"
)
CPU_FEATURES = frozenset(_FEATURES.split())
"""Instruction sets that numeric libraries choose their kernels by."""

FACTS = frozenset(("machine", "packages", "device"))
"""Metadata records whose values may differ between machines of one run."""


def record_elsewhere(group: str, machine: str) -> str:
    """Returns the name of the metadata record with facts of another machine: "dataflow:packages of robot"."""
    return f"dataflow:{group} of {machine}"


def group_of(record: str) -> tuple[str, str]:
    """Returns the group of facts of a metadata record and the machine that they are of; "" for the supervisor's."""
    group, _, machine = record.removeprefix("dataflow:").partition(" of ")
    return (group, machine) if record == record_elsewhere(group, machine) else (record, "")


def machine_facts(environment: Mapping[str, str] | None = None) -> dict[str, dict[str, str]]:
    """Metadata records `machine`, `packages`, `threads` and `device`, keys sorted; equal on an equal machine.

    `environment`: that of the processes which compute, this process's own by default. Facts that cannot be
    found out are left out or empty. Nothing is imported or started for it.
    """
    variables = os.environ if environment is None else environment
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
        "usable_cores": str(len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 0),
    }
    return {
        "machine": dict(sorted(machine.items())),
        "packages": _packages(),
        "threads": {name: variables[name] for name in THREAD_VARIABLES if name in variables},
        "device": _devices(Path("/proc/driver/nvidia"))
        | {name: variables[name] for name in KERNEL_VARIABLES if name in variables},
    }


def _cpu() -> tuple[str, frozenset[str]]:
    """Model name and feature flags; what the system does not report stays empty."""
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


def _packages() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _devices(driver: Path) -> dict[str, str]:
    """The GPUs that the NVIDIA driver names, and its version. Whether an operator uses one is its own parameter."""
    found = {}
    for number, file in enumerate(sorted(driver.glob("gpus/*/information"))):
        try:
            lines = file.read_text().splitlines()
        except OSError:
            continue
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("Model:")), "unknown")
        found[f"gpu {number}"] = model
    try:
        version_line = (driver / "version").read_text().splitlines()[0]
    except (OSError, IndexError):
        return found
    return found | {"gpu driver": version_line.partition(":")[2].strip()}
