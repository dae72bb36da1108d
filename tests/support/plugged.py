"""Devices at pseudo-terminals that are plugged in and pulled out, and free ports of loopback."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Acts = tuple[Callable[[], object], Callable[[], object]]


class Cable:
    """A pseudo-terminal that is plugged in at a path, and pulled out."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def plug(self) -> None:
        self.end, device = os.openpty()
        self.path.symlink_to(os.ttyname(device))
        os.close(device)

    def send(self, data: bytes) -> None:
        assert os.write(self.end, data) == len(data)

    def pull(self) -> None:
        self.path.unlink()
        os.close(self.end)


def while_opened(source: Any, acts: Iterable[Acts]) -> None:
    """Does something before and after each time that a source opens its device, one after the other."""
    left, whole = iter(acts), source._open

    def opened() -> Any:
        before, after = next(left)
        before()
        port = whole()
        after()
        return port

    source._open = opened


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def send_datagrams(port: int, *datagrams: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            sender.sendto(datagram, ("127.0.0.1", port))
