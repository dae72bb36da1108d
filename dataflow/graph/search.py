"""The folders in which operators' modules are sought besides the installed packages.

They stand at the end of `sys.path`: a file in one of them can never replace a module of the standard library or of an
installed package. The processes of a run are given `sys.path` as it is when they start (`import_path`).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

FOLDERS: list[str] = []
"""The folders that were added to `sys.path`, or were there already, in order."""


def add_folder(folder: str | Path) -> None:
    """Lets modules be found in `folder`: before the current folder, after everything else."""
    path = os.path.abspath(folder)
    if path in sys.path:  # of PYTHONPATH, by which this process was started
        FOLDERS.extend([] if path in FOLDERS else [path])
        return
    last = bool(FOLDERS) and sys.path[-1] == FOLDERS[-1] == _current_folder()
    sys.path.insert(len(sys.path) - last, path)
    FOLDERS.insert(len(FOLDERS) - last, path)


def add_current_folder() -> None:
    """Lets modules be found in the current folder, where there is one."""
    if (folder := _current_folder()) is not None:
        add_folder(folder)


def import_path() -> str:
    """The value of PYTHONPATH by which another process finds the same modules."""
    return os.pathsep.join(path for path in sys.path if path)


def looked_in() -> str:
    """The places where a module was sought, for messages."""
    return " and in ".join(("looked among the installed packages", *([", ".join(FOLDERS)] if FOLDERS else [])))


def _current_folder() -> str | None:
    try:
        return os.getcwd()
    except FileNotFoundError:  # it was deleted
        return None
