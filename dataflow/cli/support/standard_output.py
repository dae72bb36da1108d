"""Standard output whose failure differs from that of any other file; the console script replaces Python's by it."""

from __future__ import annotations

import io


class OutputFailed(OSError):
    """Standard output cannot be written."""


class Output(io.TextIOWrapper):
    """Standard output, whose failure differs from that of any other file."""

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputFailed(error.errno, error.strerror) from None

    def flush(self) -> None:
        try:
            super().flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            raise OutputFailed(error.errno, error.strerror) from None
