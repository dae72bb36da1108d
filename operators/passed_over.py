"""Counts the files that cannot be read and are passed over, and names them in the log."""

from __future__ import annotations

import logging

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
