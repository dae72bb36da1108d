"""The log of a running graph, for tools: lines of JSON in two files of the user's own runtime folder, bounded.

It begins with the first line and is removed when the run is over; what a dead supervisor left is removed as its entry
in the registry is.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol, TextIO

from dataflow.transport.registry import RegistryError, registry_folder

LONGEST = 4 << 20
"""Bytes of one file; a full one becomes the older of the two."""
SUFFIX, OLDER = ".log", ".log.1"


class Line(Protocol):
    """A line that can be written to it."""

    def to_json(self) -> dict[str, Any]: ...


class LogFile:
    """Writes the log of the graph that this process runs. A disk that refuses it ends this log, not the run."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._file: TextIO | None = None
        self._over = False

    def add(self, line: Line) -> None:
        if self._over:
            return
        try:
            self._write(json.dumps(line.to_json()) + "\n")
        except (OSError, RegistryError):
            self.close()

    def _write(self, text: str) -> None:
        if self._path is None:
            self._path = registry_folder() / f"{os.getpid()}-{secrets.token_hex(4)}{SUFFIX}"
        if self._file is not None and self._file.tell() > LONGEST:
            self._file.close()
            self._path.rename(self._path.with_suffix(OLDER))
            self._file = None
        if self._file is None:
            self._file = open(os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w")  # noqa: SIM115
        self._file.write(text)
        self._file.flush()

    def close(self) -> None:
        """Removes it."""
        self._over = True
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None
        if self._path is not None:
            self._path.unlink(missing_ok=True)
            self._path.with_suffix(OLDER).unlink(missing_ok=True)


class LogFollower:
    """Reads the log of a running graph: what is there, then what is added."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._open: dict[Path, tuple[TextIO, int]] = {}
        self._rest: dict[Path, str] = {}

    def lines(self) -> Iterator[dict[str, Any]]:
        """Yields what is new since the last look, in the order of each file. Lines that cannot be read are left out."""
        folder = registry_folder()
        for path in sorted(folder.glob(f"{self._pid}-*{OLDER}")):
            if path not in self._open and path.with_suffix("") not in self._open:
                with contextlib.suppress(OSError), path.open() as file:
                    yield from _parsed(file.read().splitlines())
        for path in sorted(folder.glob(f"{self._pid}-*{SUFFIX}")):
            yield from self._news(path)
        for path in [path for path in self._open if not path.exists()]:
            yield from _parsed(self._rest_of(path))

    def _news(self, path: Path) -> Iterator[dict[str, Any]]:
        try:
            number = path.stat().st_ino
            if path in self._open and self._open[path][1] != number:  # it was full, and is the older one now
                yield from _parsed(self._rest_of(path))
            if path not in self._open:
                self._open[path] = (path.open(), number)
        except OSError:
            return
        text = self._rest.pop(path, "") + self._open[path][0].read()
        *whole, rest = text.split("\n")
        self._rest[path] = rest
        yield from _parsed(whole)

    def _rest_of(self, path: Path) -> list[str]:
        file, _ = self._open.pop(path)
        with file:
            return (self._rest.pop(path, "") + file.read()).splitlines()

    def close(self) -> None:
        for file, _ in self._open.values():
            file.close()
        self._open.clear()


def _parsed(lines: list[str]) -> Iterator[dict[str, Any]]:
    for line in lines:
        with contextlib.suppress(ValueError):
            value = json.loads(line)
            if isinstance(value, dict):
                yield value
