"""Files of one recording: the parts into which it is split, their names, who may read them, what they may take."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from dataflow.recording.errors import RecordingError

OWNER_ONLY = 0o600
OnFailure = Literal["go_on", "end"]


@dataclass(frozen=True, slots=True)
class Splitting:
    """Limits of one file: bytes, or event time (ns), after which a recording goes on in the next; None: no limit.

    A file that begins with more than half of the bytes holds as much again before it is full.
    """

    size: int | None = None
    every: int | None = None

    @property
    def splits(self) -> bool:
        """Returns whether there may be more than one file."""
        return self.size is not None or self.every is not None

    def due(self, saved: int, elapsed: int, front: int = 0) -> bool:
        """Returns whether a file of `saved` bytes and `elapsed` ns of event time is full, which began with `front`
        bytes that each file begins with: below that limit, one would begin with each message."""
        large = self.size is not None and saved >= max(self.size, 2 * front)
        return large or (self.every is not None and elapsed >= self.every)


WHOLE = Splitting()
"""One file, however large."""


@dataclass(frozen=True, slots=True)
class Storage:
    """Storage of a run's recording.

    `keep`: bytes on the disk, beyond which the oldest parts of this recording are deleted; None: no limit.
    `on_failure`: whether the run goes on without a recorder that fails, or ends; None: a live run goes on, any other
    ends. `mode`: permissions of the files.
    """

    splitting: Splitting = WHOLE
    keep: int | None = None
    on_failure: OnFailure | None = None
    mode: int = OWNER_ONLY

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> Storage:
        return Storage(**{**data, "splitting": Splitting(**data["splitting"])})


def created(path: Path, overwrite: bool, mode: int) -> int:
    """Returns the descriptor of a new file with permissions `mode`. Raises `RecordingError`."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | (os.O_TRUNC if overwrite else os.O_EXCL)
    try:
        descriptor = os.open(path, flags, mode)
    except FileExistsError:
        raise RecordingError(f"{path} exists already; choose another name or ask to overwrite it") from None
    except OSError as error:
        raise RecordingError(f"cannot create the recording {path}: {error.strerror}") from error
    if overwrite:
        with contextlib.suppress(OSError):  # a file system without modes, or another user's file
            os.fchmod(descriptor, mode)
    return descriptor


def part_path(path: Path, number: int) -> Path:
    """Returns the name of a part, such as `run_002.mcap` of `run.mcap`."""
    return path.with_name(f"{path.stem}_{number:03}{path.suffix}")


def parts_of(path: Path) -> list[Path]:
    """Returns the parts of `path` that there are, in order; the file of that very name is none."""
    numbered = re.compile(re.escape(path.stem) + r"_(\d{3,})" + re.escape(path.suffix))
    files = path.parent.iterdir() if path.parent.is_dir() else ()
    found = [(int(match[1]), file) for file in files if (match := numbered.fullmatch(file.name))]
    return [file for _, file in sorted(found)]
