"""The bytes of an MCAP file: bounded reads at a position, and records by their position."""

from __future__ import annotations

import functools
import io
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError

from dataflow.recording.errors import DamagedError, RecordingError
from dataflow.recording.limits import MAX_RECORD_BYTES

RECORD = struct.Struct("<BQ")
"""The head of every record: opcode, length of the rest."""
WINDOW_BYTES = 2**16
Watch = Callable[[], None]
"""Is called before every read of a file: a sign of progress, however long it is."""


KNOWN_BYTES = 2**14
"""Records up to this size are parsed once: the files of one run declare the same, and so does a file opened again."""


def _unwatched() -> None:
    """Takes no notice."""


def _read(record: Any, body: bytes) -> Any:
    return record.read(ReadDataStream(io.BytesIO(body)))


_known = functools.lru_cache(maxsize=512)(_read)


class RawFile:
    """A file opened for reading. Raises `RecordingError` where it cannot be read, `DamagedError` beyond its end."""

    def __init__(self, path: Path, watch: Watch | None = None) -> None:
        self.path = path
        self._watch = watch or _unwatched
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise RecordingError(f"cannot open the recording {path}: {error.strerror}") from error
        self.size = os.fstat(self._fd).st_size
        self._window, self._window_start = b"", 0

    def close(self) -> None:
        """Closes the file. Idempotent."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def read(self, offset: int, size: int) -> bytes:
        """`size` bytes at `offset`."""
        if size < 0 or offset < 0 or offset + size > self.size:
            raise self.damaged(f"it points to {size} bytes at byte {offset}, but the file has {self.size}")
        data = self.read_up_to(offset, size)
        if len(data) < size:
            raise self.damaged(f"it ended at byte {offset + len(data)} while being read")
        return data

    def read_up_to(self, offset: int, size: int) -> bytes:
        """`size` bytes at `offset`, fewer where the file ends before."""
        if self._fd < 0:
            raise RecordingError(f"the recording {self.path} is closed")
        self._watch()
        try:
            data = os.pread(self._fd, size, offset)
            while len(data) < size and (more := os.pread(self._fd, size - len(data), offset + len(data))):
                data += more
        except OSError as error:
            raise RecordingError(f"cannot read the recording {self.path}: {error.strerror}") from error
        return data

    def near(self, offset: int, size: int) -> bytes:
        """As `read`, for many small pieces one after the other: the bytes around them stay in memory."""
        at = offset - self._window_start
        if at < 0 or at + size > len(self._window):
            if size > WINDOW_BYTES:
                return self.read(offset, size)
            self._window, self._window_start, at = self.read_up_to(offset, WINDOW_BYTES), offset, 0
            if size > len(self._window):
                raise self.damaged(f"it points to {size} bytes at byte {offset}, but the file has {self.size}")
        return self._window[at : at + size]

    def record(self, offset: int, length: int) -> bytes:
        """The whole record of `length` bytes behind its opcode and length."""
        if length > MAX_RECORD_BYTES:
            raise self.damaged(f"the record at byte {offset} has {length} bytes, at most {MAX_RECORD_BYTES} are read")
        return self.near(offset, RECORD.size + length)

    def parse(self, record: Any, body: bytes, offset: int) -> Any:
        """A record of the `mcap` package from its body; `offset` is where it lies."""
        try:
            return _known(record, bytes(body)) if len(body) <= KNOWN_BYTES else _read(record, body)
        except (McapError, struct.error, UnicodeDecodeError, ValueError) as error:
            raise self.damaged(f"the {record.__name__} record at byte {offset} cannot be read: {error!r}") from error

    def damaged(self, what: str) -> DamagedError:
        return DamagedError.of(self.path, what)
