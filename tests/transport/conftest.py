"""Other processes and buses for the transport tests, always ended."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from dataflow.transport import Bus, NetworkConfig, Reservation

sys.path.append(str(Path(__file__).parent))
PEER = Path(__file__).with_name("bus_peer.py")
WAIT = 30.0


class Peer:
    """A child process that says what happens in JSON lines."""

    def __init__(self, role: str, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(PEER), role, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.pid = self.process.pid
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def expect(self, event: str, timeout: float = WAIT) -> dict[str, Any]:
        """The next thing it says, which must be `event`."""
        said: dict[str, Any] = json.loads(self._lines.get(timeout=timeout))
        assert said["event"] == event, said
        return said

    def said(self) -> list[dict[str, Any]]:
        """Everything it has said and nobody has read."""
        lines = []
        while not self._lines.empty():
            lines.append(json.loads(self._lines.get()))
        return lines

    def waiting(self) -> bool:
        """Whether it has said something that nobody has read."""
        return not self._lines.empty()

    def tell(self) -> None:
        """Lets it go on."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def leave(self) -> int:
        self.tell()
        return self.process.wait(WAIT)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(WAIT)
        assert self.process.stdin is not None
        self.process.stdin.close()
        self._reader.join(WAIT)


@pytest.fixture
def peer() -> Iterator[Callable[..., Peer]]:
    """Starts child processes; all are killed at the end."""
    started: list[Peer] = []

    def start(role: str, *arguments: str) -> Peer:
        started.append(Peer(role, *arguments))
        return started[-1]

    yield start
    for child in started:
        child.kill()


@pytest.fixture
def endpoint() -> Iterator[str]:
    """A free endpoint on this machine."""
    with Reservation(1) as reserved:
        yield reserved.endpoints[0]


@pytest.fixture
def open_bus() -> Iterator[Callable[..., Bus]]:
    """Opens buses; all are closed at the end."""
    with ExitStack() as stack:

        def start(**config: Any) -> Bus:
            return stack.enter_context(Bus(NetworkConfig(**config)))

        yield start


@pytest.fixture
def pair(open_bus: Callable[..., Bus], endpoint: str) -> tuple[Bus, Bus]:
    """Two connected buses of this process."""
    first, second = open_bus(listen=(endpoint,)), open_bus(connect=(endpoint,))
    eventually(lambda: bool(first.peers() and second.peers()))
    return first, second


def eventually(condition: Callable[[], bool], timeout: float = WAIT) -> None:
    """Waits until `condition` holds; fails when it does not within `timeout` seconds."""
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"not so within {timeout:g} s"
        time.sleep(0.002)


@pytest.fixture(name="eventually")
def _eventually() -> Callable[..., None]:
    return eventually
