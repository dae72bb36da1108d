"""The one error of this package."""

from __future__ import annotations


class RecordingError(Exception):
    """A recording that cannot be written or read: names the file, what is wrong, and what would be right."""
