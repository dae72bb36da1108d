"""The lock of an environment that is built from a file of requirements, beside it.

`odometry.txt` (requirements as pip reads them) has the lock `odometry.lock`, and the environment `odometry.env`, in
which a copy of the lock shows what it was built from.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

_HEAD = "# of "
_BUILT = "built.lock"


def is_requirements(env: str) -> bool:
    """Returns whether `env:` names a file of requirements."""
    return env.endswith(".txt")


def folder_of(requirements: Path) -> Path:
    """Returns the folder of the environment."""
    return requirements.with_suffix(".env")


def lock_of(requirements: Path) -> Path:
    """Returns the path of the lock."""
    return requirements.with_suffix(".lock")


def fault(requirements: Path) -> str:
    """Returns why the environment is not that of its requirements; "" where it is."""
    if not requirements.is_file():
        return f"there is no file {requirements}"
    if not is_locked(requirements):
        return f"{lock_of(requirements)} {'is out of date' if lock_of(requirements).is_file() else 'is missing'}"
    built = folder_of(requirements) / _BUILT
    if not built.is_file():
        return f"{folder_of(requirements)} is not built"
    same = built.read_bytes() == lock_of(requirements).read_bytes()
    return "" if same else f"{folder_of(requirements)} was built from another lock"


def is_locked(requirements: Path) -> bool:
    """Returns whether there is a lock of what the requirements are now."""
    lock = lock_of(requirements)
    return lock.is_file() and lock.read_text().partition("\n")[0] == _head(requirements)


def write(requirements: Path, lines: list[str]) -> None:
    """Writes the lock."""
    lock_of(requirements).write_text("\n".join((_head(requirements), *lines, "")))


def note_built(requirements: Path) -> None:
    """Notes in the environment what it was built from."""
    (folder_of(requirements) / _BUILT).write_bytes(lock_of(requirements).read_bytes())


def _head(requirements: Path) -> str:
    return f"{_HEAD}{requirements.name}, sha256 {hashlib.sha256(requirements.read_bytes()).hexdigest()}"
