"""What names of the engine stand for while a run is simulated."""

from __future__ import annotations

import contextlib
import functools
import importlib
import pkgutil
import sys
import time
from collections.abc import Iterator
from typing import Any

ENGINE = (
    "chaos",
    "execution",
    "process",
    "records",
    "recording",
    "reexecution",
    "sinks",
    "supervision",
    "transport",
)

Bindings = dict[tuple[str, str], Any]
"""(module, name) → what it stands for."""


@functools.cache
def load() -> None:
    """Imports all modules of the engine."""
    for name in ENGINE:
        package = importlib.import_module(f"dataflow.{name}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith(".nursery_process"):
                importlib.import_module(module.name)


@functools.cache
def clocks() -> tuple[tuple[str, str], ...]:
    """Every module of the engine that reads the clock, with the name under which it does."""
    load()
    prefixes = tuple(f"dataflow.{name}." for name in ENGINE)
    return tuple(
        (name, "time")
        for name, module in sorted(sys.modules.items())
        if name.startswith(prefixes) and getattr(module, "time", None) is time
    )


@contextlib.contextmanager
def bound(bindings: Bindings) -> Iterator[None]:
    """Lets names of modules stand for something else."""
    before = {place: getattr(sys.modules[place[0]], place[1]) for place in bindings}
    try:
        for (module, name), thing in bindings.items():
            setattr(sys.modules[module], name, thing)
        yield
    finally:
        for (module, name), thing in before.items():
            setattr(sys.modules[module], name, thing)
