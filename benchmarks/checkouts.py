"""Other checkouts of this project in benchmarks: those from before a process was called one take other words."""

from __future__ import annotations

from pathlib import Path

WERE = {"--one-process": "--one-host", "--process-each": "--host-each"}


def word(root: Path, name: str) -> str:
    """An option as the checkout at `root` spells it."""
    return name if (root / "dataflow" / "supervision").exists() else WERE.get(name, name)
