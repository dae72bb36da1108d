"""The lock of an environment that is built from a file of requirements, beside it.

`odometry.txt` (requirements as pip reads them) has the lock `odometry.lock`, and the environment `odometry.env`, in
which a copy of the lock shows what it was built from. A lock is a file of requirements, too: a version of each package,
with the hashes of its files for each kind of machine on which it was built.
"""

from __future__ import annotations

import hashlib
import sys
import sysconfig
from collections.abc import Collection, Mapping
from pathlib import Path

_HEAD = "# of "
_KINDS = "# hashes of "
_HASH = " --hash=sha256:"
_BUILT = "built.lock"
HERE = f"{sysconfig.get_platform()} {sys.implementation.cache_tag}"
"""The kind of this machine: wheels of others are other files."""
Pins = Mapping[str, Collection[str]]
"""By line of a package, as pip reads it, the SHA-256 of its files; none of a folder or a repository."""


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


def kinds(requirements: Path) -> set[str]:
    """Returns the kinds of machine whose files the hashes are of."""
    named = [line for line in _lines(requirements) if line.startswith(_KINDS)]
    return {kind for line in named for kind in line.removeprefix(_KINDS).split(", ")}


def pins(requirements: Path) -> dict[str, set[str]]:
    """Returns what is locked, with the hashes."""
    found = {}
    for line in _lines(requirements):
        if line and not line.startswith(("#", "-")):
            pin, *hashes = line.split(_HASH)
            found[pin] = set(hashes)
    return found


def write(requirements: Path, options: Collection[str], locked: Pins, machines: Collection[str] = (HERE,)) -> None:
    """Writes the lock: options that say where packages are looked for, and what is locked for kinds of machines."""
    head = (_head(requirements), _KINDS + ", ".join(sorted(machines)), *options)
    lock_of(requirements).write_text("\n".join((*head, *lines(locked), "")))


def lines(locked: Pins) -> list[str]:
    """Returns the lines of packages in a file for pip."""
    return ["".join((pin, *(_HASH + each for each in sorted(locked[pin])))) for pin in sorted(locked, key=str.lower)]


def _lines(requirements: Path) -> list[str]:
    return lock_of(requirements).read_text().splitlines()


def note_built(requirements: Path) -> None:
    """Notes in the environment what it was built from."""
    (folder_of(requirements) / _BUILT).write_bytes(lock_of(requirements).read_bytes())


def _head(requirements: Path) -> str:
    return f"{_HEAD}{requirements.name}, sha256 {hashlib.sha256(requirements.read_bytes()).hexdigest()}"
