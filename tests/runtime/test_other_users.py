"""Another user of the machine finds nothing of a running graph: no socket, no file, no memory, no port."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

HERE = Path(__file__).resolve().parent
NOBODY = 65534
GRAPH = """
graph: private
namespace: test
operators:
  left: {use: faulty_operators:Large, params: {count: 100000}}
  right: {use: faulty_operators:Waker, inputs: {x: left/fast}, params: {at: -1, file: none}}
"""

pytestmark = pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")


@pytest.fixture
def folder() -> Iterator[Path]:
    """A runtime folder that everybody may enter, so that only what lies in it keeps others out."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        path = Path(name)
        path.chmod(0o755)
        yield path


@pytest.fixture
def running(folder: Path, tmp_path: Path) -> Iterator[psutil.Process]:
    """The supervisor of a live graph with a process for each operator, which send each other large messages."""
    (tmp_path / "private.yaml").write_text(GRAPH)
    command = [sys.executable, "-P", "-m", "dataflow.cli.main", "run", str(tmp_path / "private.yaml")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent.parent)]),
        "XDG_RUNTIME_DIR": str(folder),
    }
    process = subprocess.Popen([*command, "--live", "--process-each", "--quiet"], env=environment, cwd=tmp_path)
    deadline = time.monotonic() + 60
    while not pools(process.pid):
        assert time.monotonic() < deadline, "no large message was sent"
        time.sleep(0.05)
    yield psutil.Process(process.pid)
    process.terminate()
    process.wait(60)


def pools(pid: int) -> list[str]:
    """The shared memory that the processes of a run have open."""
    found = []
    for process in psutil.Process(pid).children(recursive=True):
        for number in Path(f"/proc/{process.pid}/fd").iterdir():
            try:
                found += [str(number)] if "dataflow-pool-" in os.readlink(number) else []
            except FileNotFoundError:  # it was closed meanwhile
                continue
    return found


def as_nobody(attempts: dict[str, Callable[[], Any]]) -> dict[str, str]:
    """What another user's process meets that tries these: the error's name, or that it may."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            for name, attempt in attempts.items():
                said = "allowed"
                try:
                    attempt()
                except OSError as error:
                    said = type(error).__name__
                os.write(writing, f"{name}: {said}\n".encode())
        finally:
            os._exit(0)
    os.close(writing)
    os.waitpid(pid, 0)
    with os.fdopen(reading) as pipe:
        return dict(line.rstrip("\n").rsplit(": ", 1) for line in pipe)


def test_another_user_can_neither_read_nor_write_a_running_graph(running: psutil.Process, folder: Path) -> None:
    (private,) = folder.iterdir()
    files = [path for path in private.rglob("*") if path.is_file()]
    sockets = [path for path in private.rglob("*") if path.is_socket()]
    memory = pools(running.pid)
    processes = [running, *running.children(recursive=True)]
    assert files
    assert sockets
    attempts: dict[str, Callable[[], Any]] = {
        "list": lambda: os.listdir(private),
        "make": lambda: (private / "mine").touch(),
    }
    attempts |= {f"read {path.name}": path.read_bytes for path in files}
    attempts |= {f"connect {p}": lambda p=p: socket.socket(socket.AF_UNIX).connect(str(p)) for p in sockets}
    attempts |= {f"open {path}": lambda path=path: os.open(path, os.O_RDONLY) for path in memory}
    attempts |= {f"write {path}": lambda path=path: os.open(path, os.O_RDWR) for path in memory}
    attempts |= {f"signal {p.pid}": lambda p=p: os.kill(p.pid, 0) for p in processes}

    met = as_nobody(attempts)

    assert met == dict.fromkeys(attempts, "PermissionError")
    assert not [each for process in processes for each in process.net_connections(kind="inet")]
