"""A process that has ended is never signalled by its number, which another process may have by then."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import dataflow
from dataflow.process.channel import QueuedChannel
from dataflow.supervision.nursery import Child

PACKAGE = Path(dataflow.__file__).parent
BY_NUMBER = {"kill", "killpg"}
NOT_WAITED_FOR_YET = {
    "supervision/nursery.py": 1,
    "supervision/nursery_process.py": 3,
    "parent.py": 1,
    "process/start.py": 1,
    "sweep/warm_process.py": 2,
    "tool_server/jobs.py": 1,
    "verification/workers/prestart.py": 1,
    "verification/workers/worker.py": 1,
}
"""Where a number is used: by the parent, of a child that it waits for only afterwards, which keeps the number taken; in
`parent.py` by a process for itself."""


@pytest.fixture
def bystander() -> Iterator[subprocess.Popen[bytes]]:
    """A process that has the number of one that has ended."""
    process = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE)
    yield process
    process.kill()
    process.communicate()


def ended() -> int:
    """A handle of a process that has ended and was waited for."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    handle = os.pidfd_open(process.pid)
    process.wait()
    return handle


@pytest.mark.parametrize("early", [False, True], ids=["asked for afterwards", "asked for before it was born"])
def test_a_process_that_got_the_number_of_an_ended_one_is_left_alone(
    bystander: subprocess.Popen[bytes], early: bool
) -> None:
    channel = QueuedChannel()
    reading, writing = os.pipe()
    child = Child(channel, reading)
    if early:
        child.signal(signal.SIGKILL)
    child.born(bystander.pid, ended())
    if not early:
        child.signal(signal.SIGKILL)

    assert child.dead
    bystander.communicate(timeout=30)
    assert bystander.returncode == 0  # it read to the end of its input
    child.close()
    os.close(channel.theirs)
    os.close(writing)


@pytest.mark.long
def test_processes_are_signalled_by_number_only_where_allowed() -> None:
    found: dict[str, int] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            called = node.func if isinstance(node, ast.Call) else None
            if isinstance(called, ast.Attribute) and called.attr in BY_NUMBER and ast.unparse(called.value) == "os":
                name = path.relative_to(PACKAGE).as_posix()
                found[name] = found.get(name, 0) + 1
    assert found == NOT_WAITED_FOR_YET
