"""The errors of this package."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from dataflow.text import visible


class RecordingError(Exception):
    """A recording that cannot be written or read: names the file, what is wrong, and what would be right.

    Control characters of the text are escaped: it may quote the file, and is printed to a terminal.
    """

    def __init__(self, text: str) -> None:
        super().__init__(visible(text))


class DamagedError(RecordingError):
    """A file whose bytes contradict each other or the format."""

    what = ""
    """The contradiction, without the file's name."""

    @classmethod
    def of(cls, path: Path, what: str) -> Self:
        error = cls(f"{path} is damaged: {what}; `dataflow recover` may save what is left")
        error.what = visible(what)
        return error
