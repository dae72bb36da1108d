"""Recordings opened again: the index of a file, which nobody writes any more, is read once."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dataflow.recording.mcap.cache import ChunkCache
from dataflow.recording.mcap.index import McapFile
from dataflow.recording.mcap.message_index import LoadedIndex
from dataflow.recording.mcap.rawfile import RawFile, Watch
from dataflow.recording.streams.streams import StreamFinder
from simulation.bindings import bound

State = tuple[Path, int, int, int]
"""Path, inode, size and time of the last write of a file."""


class _Known:
    """Files by their states, each as it was when it was opened, and with the streams that were found in it."""

    def __init__(self) -> None:
        self._files: dict[State, McapFile] = {}
        self._streams: dict[int, Any] = {}

    def open(self, path: Path, *, watch: Watch | None = None, **options: Any) -> McapFile:
        try:
            status = os.stat(path)
        except OSError:
            return McapFile(path, watch=watch, **options)
        state = path, status.st_ino, status.st_size, status.st_mtime_ns
        if options or (known := self._files.get(state)) is None:
            opened = McapFile(path, watch=watch, **options)
            if not options and isinstance(opened.index, LoadedIndex):
                self._files[state] = _again(opened, opened._file)
            return opened
        return _again(known, RawFile(path, watch))

    def streams(self, file: Any) -> Any:
        index = getattr(file, "index", None)
        if index is None:
            return StreamFinder(file)
        return _Found(self._streams, file)


class _Found:
    """Stands for `StreamFinder`: streams are those of the index."""

    def __init__(self, known: dict[int, Any], file: McapFile) -> None:
        self._known, self._file = known, file

    def all(self) -> Any:
        key = id(self._file.index)
        if key not in self._known:
            self._known[key] = self._file.index, StreamFinder(self._file).all()
        return dict(self._known[key][1])


def _again(file: McapFile, raw: RawFile) -> McapFile:
    """The same file, opened again."""
    again = copy.copy(file)
    again._file, again.damage, again._chunks = raw, list(file.damage), copy.copy(file._chunks)
    again._chunks._file, again._chunks.cache = raw, ChunkCache()
    return again


@contextmanager
def opened_once() -> Iterator[None]:
    """Has each file's index read once while the block runs, in which none is written to that was opened."""
    known = _Known()
    reader = "dataflow.recording.streams.reader"
    with bound({(reader, "McapFile"): known.open, (reader, "StreamFinder"): known.streams}):
        yield
