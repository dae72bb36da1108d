"""Sockets that only their owner can open: where the processes of a run listen for each other and for tools."""

from __future__ import annotations

import os
import secrets
from types import TracebackType
from typing import Final, Self

from dataflow.transport.registry import is_abandoned, registry_folder, remove, temporary_folder

MAX_PATH: Final = 103
"""Bytes that the path of a Unix socket may have: 107 on Linux, 103 on macOS."""
SUFFIX: Final = ".run"


class Reservation:
    """The Zenoh endpoints of one run: Unix sockets in a folder of mode 0700, which lasts until `close`.

    The folder lies beside the registry's files or, where that path is too long for a socket, in the temporary folder.
    """

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def reserve_endpoints(count: int) -> Reservation:
    """Returns `count` endpoints on this machine that no other process can listen on or connect to."""
    return Reservation(count)
