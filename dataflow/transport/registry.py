"""The graphs that run on this machine, for tools to find: one small file for each, in a folder of this user alone.

The sockets of their processes lie in the same folder. The next reader removes what a dead process left.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Self

START_TOLERANCE = 1.0


class RegistryError(RuntimeError):
    """The folder of running graphs cannot be used; the message has the reason."""


@dataclass(frozen=True, slots=True)
class RunningGraph:
    """A graph that runs on this machine.

    `endpoints` are the Zenoh endpoints of all its processes, sockets that only this user can open: a tool connects to
    every one. `started` is the wall time (seconds since the epoch) at which the graph was registered. `graph` is the
    resolved graph as JSON values.
    """

    name: str
    namespace: str
    pid: int
    """The supervisor's process."""
    process_started: float
    endpoints: tuple[str, ...]
    started: float
    graph: Mapping[str, Any]
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of Zenoh by which a graph of another machine is reached; empty for one of this machine."""


def registry_folder() -> Path:
    """Returns `$XDG_RUNTIME_DIR/dataflow`, else a folder in the temporary one; makes it on first use. Raises
    `RegistryError` when it exists but is another user's, or open to others."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return private_folder(Path(runtime) / "dataflow") if runtime else temporary_folder()


def temporary_folder() -> Path:
    """Returns this user's folder in the temporary one; as `registry_folder`."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    return private_folder(Path(tempfile.gettempdir()) / f"dataflow-{user}")


def private_folder(folder: Path) -> Path:
    """Makes a folder that only this user can enter; raises `RegistryError` when there is another one in its place."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise RegistryError(f"cannot make the folder of running graphs {folder}: {error}") from error
    if not stat.S_ISDIR(status.st_mode):
        raise RegistryError(f"{folder} is no folder; remove it, or set XDG_RUNTIME_DIR to another folder")
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o077):
        raise RegistryError(
            f"{folder} must belong to user {os.getuid()} with mode 0700, but belongs to {status.st_uid} with mode "
            f"{stat.S_IMODE(status.st_mode):04o}; remove it, or set XDG_RUNTIME_DIR to another folder"
        )
    return folder


@contextmanager
def register(
    name: str, namespace: str, endpoints: Sequence[str], graph: Mapping[str, Any] | None = None
) -> Iterator[RunningGraph]:
    """Makes this process's graph known to tools for as long as the block runs. `graph` must be JSON values."""
    running()  # clears away what others have left
    pid = os.getpid()
    entry = RunningGraph(
        name, namespace, pid, _born(pid), tuple(endpoints), started=time.time(), graph=dict(graph or {})
    )
    path = registry_folder() / f"{pid}-{secrets.token_hex(4)}.json"
    written = path.with_suffix(".new")
    with open(os.open(written, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(json.dumps(asdict(entry)))
    written.rename(path)
    try:
        yield entry
    finally:
        path.unlink(missing_ok=True)


def running() -> list[RunningGraph]:
    """Returns this user's graphs that run on this machine, the oldest first. Removes what dead processes left."""
    found = []
    for path in registry_folder().iterdir():
        entry = _read(path)
        if entry is not None and _lives(entry.pid, entry.process_started):
            found.append(entry)
        elif entry is not None or is_abandoned(path):
            remove(path)
    return sorted(found, key=lambda g: (g.started, g.pid))


def _read(path: Path) -> RunningGraph | None:
    if path.suffix != ".json":
        return None
    try:
        data = json.loads(path.read_text())
        return RunningGraph(
            name=str(data["name"]),
            namespace=str(data["namespace"]),
            pid=int(data["pid"]),
            process_started=float(data["process_started"]),
            endpoints=tuple(str(e) for e in data["endpoints"]),
            started=float(data["started"]),
            graph=dict(data["graph"]),
        )
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _lives(pid: int, process_started: float) -> bool:
    """Returns whether that very process still runs; a later process with the same id began at another time."""
    try:
        return abs(_born(pid) - process_started) < START_TOLERANCE
    except ProcessLookupError:
        return False


def _born(pid: int) -> float:
    """When a process began, in seconds since the epoch. Raises `ProcessLookupError` where none runs, or a zombie."""
    try:
        state, *rest = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        raise ProcessLookupError(pid) from None
    if state == "Z":
        raise ProcessLookupError(pid)
    booted = next(line for line in Path("/proc/stat").read_text().splitlines() if line.startswith("btime "))
    return int(booted.split()[1]) + int(rest[18]) / os.sysconf("SC_CLK_TCK")


def is_abandoned(path: Path) -> bool:
    """Returns whether the process that a file or folder `<process>-...` belongs to is gone."""
    pid = path.name.partition("-")[0]
    return pid.isdigit() and not Path(f"/proc/{pid}").exists()


def remove(path: Path) -> None:
    """Removes a file, or a folder with what is in it; one that is gone is left so."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


MAX_PATH: Final = 103
"""Bytes that the path of a Unix socket may have: 107 on Linux, 103 on macOS."""
SUFFIX: Final = ".run"


class Reservation:
    """`count` Zenoh endpoints of one run: Unix sockets in a folder of mode 0700, which lasts until `close`. The folder
    lies beside the registry's files or, where that path is too long for a socket, in the temporary folder."""

    def __init__(self, count: int) -> None:
        """Makes the folder; raises `RegistryError` when it cannot be this user's alone."""
        name = f"{os.getpid()}-{secrets.token_hex(4)}{SUFFIX}"
        parent = registry_folder()
        if len(os.fsencode(parent / name / str(count))) > MAX_PATH:
            parent = temporary_folder()
            for left in parent.glob(f"*{SUFFIX}"):
                if is_abandoned(left):
                    remove(left)
        self._folder = parent / name
        self._folder.mkdir(mode=0o700)
        self.endpoints = tuple(f"unixsock-stream/{self._folder / str(number)}" for number in range(count))

    def close(self) -> None:
        """Removes the folder; further calls do nothing."""
        remove(self._folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
