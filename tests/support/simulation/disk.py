"""The simulated disk: files in memory, with a size that may be used up and writes that may take their time.

What a file holds is kept in a real one (on a file system in memory), so that the code that reads recordings reads it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from simulation.world import World

LARGE = 1 << 40


class Disk:
    """The module `os` for who writes files below `folder`. `room`: bytes that they take until it is full; `slow`:
    seconds that a write may take."""

    def __init__(self, world: World, folder: Path | None, *, room: int | None = None, slow: float = 0.0) -> None:
        self._world, self._folder, self._room, self._slow = world, folder, room, slow
        self._opened: dict[int, Callable[[], None]] = {}
        self.full = False
        self._busy: list[tuple[float, float]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def open(self, path: Path, flags: int, mode: int) -> int:
        self._world.effect()
        descriptor = os.open(path, flags, mode)
        task = self._world.task
        if task is not None:
            self._opened[descriptor] = close = lambda: os.close(descriptor)
            task.process.closers.append(close)
        return descriptor

    def write(self, descriptor: int, data: memoryview) -> int:
        """May take only a part, may take long, and may find no room."""
        world = self._world
        world.effect()
        if self._slow:
            begun = world.now
            world.wait(world.random.random() * self._slow)
            self._busy.append((begun, world.now))
        count = len(data)
        if world.random.random() < 0.1:
            count = world.random.randint(1, count)
        room = self._free()
        if not room:
            self.full = True
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return os.write(descriptor, data[: min(count, room)])

    def busy(self, since: float) -> float:
        """Seconds that writes took since then."""
        return sum(max(0.0, until - max(begun, since)) for begun, until in self._busy)

    def grow(self, more: int) -> None:
        """Makes room, as by deleting what others have written."""
        if self._room is not None:
            self._room += more

    def statvfs(self, folder: Path) -> Any:
        return SimpleNamespace(f_bavail=self._free(), f_frsize=1, f_blocks=self._room or LARGE)

    def _free(self) -> int:
        """Bytes that there is room for: what was deleted takes none."""
        if self._room is None or self._folder is None:
            return LARGE
        return max(0, self._room - sum(file.stat().st_size for file in self._folder.rglob("*") if file.is_file()))

    def close(self, descriptor: int) -> None:
        task = self._world.task
        if task is not None:
            task.process.closers.remove(self._opened.pop(descriptor))
        os.close(descriptor)
