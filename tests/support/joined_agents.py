"""Agents on this machine that play another one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parents[1] / "machines"
"""The folder of the operators that their runs use."""
END_WITHIN = 20.0


@dataclass(frozen=True, slots=True)
class Robot:
    """A machine that has joined: where runs have to listen, the agent's folder, and that of its code."""

    endpoint: str
    folder: Path
    code: Path
    process: subprocess.Popen[str]


def join(name: str, connect: str, folder: Path, *words: str, code: Path = HERE) -> subprocess.Popen[str]:
    """Starts an agent, which finds operators in `code`; it is given relative paths, as users give them."""
    given = [os.path.relpath(word, folder.parent) if os.path.isabs(word) else word for word in words]
    command = [sys.executable, "-m", "dataflow.cli.main", "join", name, "--connect", connect]
    return subprocess.Popen(
        [*command, "--folder", folder.name, *given],
        env={**os.environ, "PYTHONPATH": str(code)},
        cwd=folder.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> str:
    """Ends an agent in order; returns what it said."""
    process.send_signal(signal.SIGTERM)
    return process.communicate(timeout=END_WITHIN)[0]
