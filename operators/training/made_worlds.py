"""Files of what simulated worlds give, one each: those that a folder lacks are made, several at once."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol

KINDS = ("office", "table_top", "corridor", "yard")

Chosen = tuple[str, int, int]
"""Kind, seed and number of people of a world."""


class StorableResult(Protocol):
    """Result of a world, which a file can keep."""

    def write(self, file: Path) -> None: ...


def worlds(first: int, count: int) -> list[Chosen]:
    """Returns `count` worlds (kind, seed, people), kinds and numbers of people in turn."""
    return [(KINDS[k % len(KINDS)], first + k, (3, 3, 4, 2)[(k // len(KINDS)) % 4]) for k in range(count)]


def file_of(folder: Path, world: Chosen) -> Path:
    """Returns where a folder has a world."""
    kind, seed, people = world
    return folder / f"{kind}_{seed}_{people}.npz"


def write_lacking(
    folder: Path, chosen: Sequence[Chosen], processes: int, make: Callable[[str, int, int], StorableResult]
) -> Iterator[int]:
    """Writes what `make` gives of each world that the folder lacks; yields how many are made after each.

    `make` must be a function of a module, since other processes call it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lacking = [world for world in chosen if not file_of(folder, world).is_file()]
    if not lacking:
        return
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for k, _ in enumerate(pool.imap(partial(_write, folder, make), lacking)):
            yield k + 1


def _write(folder: Path, make: Callable[[str, int, int], StorableResult], world: Chosen) -> None:
    file = file_of(folder, world)
    unfinished = file.with_suffix(".partial.npz")
    make(*world).write(unfinished)
    unfinished.replace(file)
