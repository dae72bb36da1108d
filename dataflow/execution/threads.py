"""Fixes the thread counts of the numerical libraries: results must not depend on how many cores there are."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from dataflow.graph.search import import_path

_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "TBB_NUM_THREADS",
)


THREADS = (*_VARIABLES, "DATAFLOW_THREADS")
"""Environment variables that set libraries' number of threads; most read them when they load."""


def environment(threads: int) -> dict[str, str]:
    """Returns the environment of operators: thread counts, the import path of this process, hashing without a salt."""
    return {
        **os.environ,
        "PYTHONPATH": import_path(),
        **dict.fromkeys(_VARIABLES, str(threads)),
        "PYTHONHASHSEED": "0",
        "DATAFLOW_THREADS": str(threads),
    }


def take_over(environment: Mapping[bytes, bytes]) -> None:
    """Takes an environment as if this process had been started with it, the path of modules included; what was read of
    the old one stays as it is."""
    os.environb.clear()
    os.environb.update(environment)
    first = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = [*first, *(path for path in sys.path if path not in first)]


_limit: int | None = None


def limit_threads(threads: int) -> None:
    """Limits loaded libraries that have a separate thread setting. Called after the operators' imports."""
    global _limit
    _limit = threads
    limit_threads_again()


def limit_threads_again() -> None:
    """Limits the libraries that were loaded since, as `setup()` of an operator may do. Nothing if there is no limit."""
    threads = _limit
    if threads is None:
        return
    modules: dict[str, Any] = sys.modules
    if (cv2 := modules.get("cv2")) is not None:
        cv2.setNumThreads(threads)
    if (torch := modules.get("torch")) is not None:
        torch.set_num_threads(threads)


@contextmanager
def limited_threads(threads: int) -> Iterator[None]:
    """Limits those libraries while a graph runs in a process that has other work too, and takes the limit back."""
    global _limit
    outer = _limit
    modules: dict[str, Any] = sys.modules
    loaded = {name: modules[name] for name in ("cv2", "torch") if name in modules}
    before = {
        name: library.getNumThreads() if name == "cv2" else library.get_num_threads()
        for name, library in loaded.items()
    }
    limit_threads(threads)
    try:
        yield
    finally:
        _limit = outer
        for name, library in loaded.items():
            (library.setNumThreads if name == "cv2" else library.set_num_threads)(before[name])
