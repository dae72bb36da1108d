"""Follows the modules that a call of an operator loads: whether another one has loaded them before must not matter.

A library with a generator is seeded as soon as it is loaded, with the seed of the call, and gets the thread limits of
those that were loaded before. If a module draws from the global generators of Python and numpy while it is loaded, or
seeds them, their state is restored.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, SupportsInt

from dataflow.execution.generators import lazy_numpy, lazy_random
from dataflow.execution.threads import limit_threads_again


class Loads:
    """A finder of modules (`sys.meta_path`) that finds what the others do, and follows what is loaded in a call."""

    def __init__(self) -> None:
        self.seed: SupportsInt | None = None
        """The seed of the call that is under way; None outside of calls, and where loading is not followed."""
        self.thread = 0
        """The thread of that call."""
        self._loaded: Callable[[SupportsInt], None] = lambda seed: None
        self._at_work = threading.local()

    def follow(self, loaded: Callable[[SupportsInt], None]) -> None:
        """Begins to follow; `loaded` is called with the seed of the call after something was loaded in it."""
        self._loaded = loaded
        if self not in sys.meta_path:
            sys.meta_path.insert(0, self)

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> Any:
        """Finds a module by way of the other finders; loading the first of several that need each other is followed."""
        if self.seed is None or getattr(self._at_work, "loading", False):
            return None
        for finder in sys.meta_path:
            if finder is not self and (spec := finder.find_spec(name, path, target)) is not None:
                self._follow(spec)
                return spec
        return None

    def _follow(self, spec: ModuleSpec) -> None:
        loader: Any = spec.loader
        if not hasattr(loader, "__dict__") or isinstance(loader, type):
            return  # built-in and frozen modules, and packages without a file: they hold no generator and draw nothing

        def exec_module(module: ModuleType) -> None:
            del loader.exec_module
            with self._loading():
                loader.exec_module(module)

        loader.exec_module = exec_module

    @contextmanager
    def _loading(self) -> Iterator[None]:
        if (seed := self.seed) is None:  # it was found in a call, and is loaded after that
            yield
            return
        here = threading.get_ident() == self.thread  # another thread, such as a live source's, draws beside the call
        held = (lazy_random.held(), lazy_numpy.held()) if here else None
        self._at_work.loading = True
        try:
            yield
        finally:
            self._at_work.loading = False
            if held is not None:
                lazy_random.give_back(held[0])
                lazy_numpy.give_back(held[1])
            limit_threads_again()
            self._loaded(seed)


LOADS = Loads()
