"""Notes of files that are opened, for commands, which print them whatever they do with the file."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

Listener = Callable[[Path, str], None]

_listeners: list[Listener] = []


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Calls a function with (file, note) for every note of files that this process opens meanwhile."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


@contextmanager
def warning() -> Iterator[None]:
    """Turns the notes of files that this process opens meanwhile into Python's warnings, each once."""
    found: dict[str, None] = {}

    def take(file: Path, note: str) -> None:
        found[note if file.name in note else f"{file}: {note}"] = None

    try:
        with listening(take):
            yield
    finally:
        for note in found:
            warnings.warn(note, stacklevel=4)


def notice(file: Path, notes: Sequence[str]) -> None:
    """Announces damage and oddities of a file that was opened."""
    for listener in _listeners:
        for note in notes:
            listener(file, note)
