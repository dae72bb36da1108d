"""An agent that plays the other machine, and keys for both."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE))
END_WITHIN = 20.0


@dataclass(frozen=True, slots=True)
class Robot:
    """A machine that has joined: where runs have to listen, the agent's folder, and that of its code."""

    endpoint: str
    folder: Path
    code: Path
    process: subprocess.Popen[str]


def join(name: str, connect: str, folder: Path, *words: str, code: Path = HERE) -> subprocess.Popen[str]:
    """Starts an agent, which finds operators in `code`."""
    return subprocess.Popen(
        [sys.executable, "-m", "dataflow.cli.main", "join", name, "--connect", connect, "--folder", folder, *words],
        env={**os.environ, "PYTHONPATH": str(code)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> str:
    """Ends an agent in order; returns what it said."""
    process.send_signal(signal.SIGTERM)
    return process.communicate(timeout=END_WITHIN)[0]


@pytest.fixture(scope="session")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A machine called robot, which takes part in one run after the other; joined over a socket of this user."""
    folder = tmp_path_factory.mktemp("robot")
    endpoint = f"unixsock-stream/{folder / 'meet'}"
    code = folder / "code"
    shutil.copytree(HERE, code)
    process = join("robot", endpoint, folder / "files", code=code)
    yield Robot(endpoint, folder / "files", code, process)
    assert process.poll() is None
    end(process)
