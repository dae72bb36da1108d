"""Files that are written whole or not at all, and checkpoints read without running anything they contain."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch


class TrainingFileError(ValueError):
    """A file that training or evaluation cannot use: names it, what is wrong, and what would be right."""


@contextlib.contextmanager
def whole(file: Path) -> Iterator[Path]:
    """A path to write to, which takes the place of `file` when the block ends without an error."""
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)


def save_atomically(state: Mapping[str, Any], file: Path) -> None:
    """Writes a checkpoint; a crash at any moment leaves the previous one or the new one, never a part."""
    with whole(file) as partial, partial.open("wb") as handle:
        torch.save(dict(state), handle)
        handle.flush()
        os.fsync(handle.fileno())


def load_safely(file: Path) -> dict[str, Any]:
    """The dictionary in a checkpoint: tensors and plain values only (`weights_only=True`), on the CPU.

    Raises FileNotFoundError or TrainingFileError.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no file {str(file)!r} (looked for {file.absolute()})")
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle, zip and torch errors share no base
        raise TrainingFileError(f"{file} is no readable checkpoint of tensors and plain values: {error}") from error
    if not isinstance(state, dict):
        raise TrainingFileError(f"{file} holds a {type(state).__name__}; a checkpoint is a dictionary")
    return state
