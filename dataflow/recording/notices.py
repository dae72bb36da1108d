"""Notes of files that are opened, for commands, which print them whatever they do with the file."""

from __future__ import annotations

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


def notice(file: Path, notes: Sequence[str]) -> None:
    """Announces damage and oddities of a file that was opened."""
    for listener in _listeners:
        for note in notes:
            listener(file, note)
