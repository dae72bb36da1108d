"""Functions that tests call in workers."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dataflow.verification.workers.board import Board


def describe(request: Mapping[str, Any], board: Board) -> dict[str, Any]:
    """The request and the environment that matters; printing does not disturb the answer."""
    print("this goes nowhere")
    return {**request, **{name: os.environ[name] for name in ("OMP_NUM_THREADS", "PYTHONHASHSEED")}}


def fail(request: Mapping[str, Any], board: Board) -> None:
    raise RuntimeError("the wheels came off")


def stall(request: Mapping[str, Any], board: Board) -> None:
    """Makes a few steps, and none after them."""
    for _ in range(3):
        board.begins("fire", "smooth")
    print("thinking", flush=True)
    time.sleep(3600)


def die(request: Mapping[str, Any], board: Board) -> None:
    """Dies in an operator's call, of a signal or with an exit code."""
    board.begins(request["phase"], "smooth")
    if request["code"] >= 0:
        os._exit(request["code"])
    os.kill(os.getpid(), -request["code"])


def leave_children(request: Mapping[str, Any], board: Board) -> None:
    """Starts a process, notes its number, and dies."""
    child = subprocess.Popen(["sleep", "600"])
    Path(request["note"]).write_text(str(child.pid))
    os.kill(os.getpid(), signal.SIGKILL)


def wait_for_ever(request: Mapping[str, Any], board: Board) -> None:
    """Says that it runs, and goes on making steps."""
    Path(request["note"]).write_text(str(os.getpid()))
    while True:
        board.begins("read", "")
        time.sleep(0.01)
