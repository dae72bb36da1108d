"""Files of a drive of KITTI raw: where they lie, and their times."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dataflow.operator import SourceError

_CALIBRATIONS = (("calib.txt",), ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt"))


def files_in(folder: Path, places: tuple[str, ...], suffix: str) -> list[Path]:
    """The files in the first of some places that holds any. Raises SourceError where none does."""
    for place in places:
        found = sorted((folder / place).glob(f"*{suffix}"))
        if found:
            return found
    raise SourceError(f"no {suffix} files in {' or '.join(str(folder / place) for place in places)}")


def calibration_files(folder: Path) -> tuple[Path, ...]:
    """The calibration files of a drive, there or in the folder above. Raises SourceError."""
    for home in (folder, folder.parent):
        for names in _CALIBRATIONS:
            if all((home / name).is_file() for name in names):
                return tuple(home / name for name in names)
    wanted = " or ".join(" with ".join(names) for names in _CALIBRATIONS)
    raise SourceError(f"no calibration in {folder} or the folder above: {wanted}")


def read_stamps(file: Path, names: list[str], what: str) -> dict[str, int]:
    """Returns the stamp of every frame, ns since the epoch; nothing where there is no such file.

    Of a drive that lacks files, whose times are all there, a line belongs to the frame of its number.
    """
    if not file.is_file():
        return {}
    lines = [line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]
    if len(lines) > len(names) and all(name.isdecimal() and int(name) < len(lines) for name in names):
        lines = [lines[int(name)] for name in names]
    if len(lines) != len(names):
        raise SourceError(f"{file} has {len(lines)} lines for {len(names)} {what}")
    stamps = []
    for number, line in enumerate(lines, start=1):
        try:
            whole, _, part = line.partition(".")
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            stamps.append(int(moment.timestamp()) * 10**9 + int((part or "0").ljust(9, "0")[:9]))
        except ValueError:
            raise SourceError(f"{file}, line {number}: {line!r} is no date and time") from None
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            raise SourceError(f"{file}, line {number}: the time is not later than that of the line before")
    return dict(zip(names, stamps, strict=True))


class Numbers:
    """The numbers of calibration files, taken together: lines of a key, a colon and numbers."""

    def __init__(self, *files: Path) -> None:
        self._named = ", ".join(file.name for file in files)
        self._values: dict[str, list[float]] = {}
        for file in files:
            for line in file.read_text(encoding="utf-8").splitlines():
                key, colon, rest = line.partition(":")
                if not colon or line.startswith("#"):
                    continue
                try:
                    self._values[key.strip()] = [float(word) for word in rest.split()]
                except ValueError:
                    continue  # dates and names

    def of(self, count: int, *keys: str) -> NDArray[np.float64]:
        """The numbers (count,) of the first key that is there. Raises SourceError."""
        for key in keys:
            if key in self._values:
                found = np.array(self._values[key])
                if len(found) != count or not np.isfinite(found).all():
                    raise SourceError(f"{self._named}: {key} must have {count} finite numbers, has {len(found)}")
                return found
        raise SourceError(f"{self._named}: no {' or '.join(keys)}")
