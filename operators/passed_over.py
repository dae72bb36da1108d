"""Counts the files that cannot be read and are passed over, and names them in the log."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from itertools import islice
from typing import TypeVar

from dataflow.operator import SourceError

Found = TypeVar("Found")
Read = TypeVar("Read")

TRIED = 100
"""Frames of which one has to be readable: else it is not a matter of single files."""


class PassedOver:
    """Counts what cannot be read: the first, second, fourth ... is a warning. `strict`: each is an error."""

    def __init__(self, log: logging.LoggerAdapter[logging.Logger] | logging.Logger, *, strict: bool) -> None:
        self._log, self._strict = log, strict
        self.number = 0

    def take(self, error: Exception) -> None:
        """Passes over what an error names; raises it where that is not allowed."""
        if self._strict:
            raise error
        self.number += 1
        if not self.number & (self.number - 1):
            more = f" ({self.number:,} so far)" if self.number > 1 else ""
            self._log.warning("%s: passed over%s", error, more)

    def first(self, files: Iterable[Found], read: Callable[[Found], Read]) -> Read:
        """Returns what the first file that can be read gives. Raises the first error where none of `TRIED` can."""
        refused: SourceError | None = None
        for file in islice(files, 1 if self._strict else TRIED):
            try:
                return read(file)
            except SourceError as error:
                refused = refused or error
        assert refused is not None
        raise refused
