"""Rerun's own program as a child process: the native viewer, or the server behind a browser. Loopback only."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from dataflow.parent import end_with_parent

LOOPBACK = "127.0.0.1"
_START_TIMEOUT = 15.0  # seconds


class ViewerError(RuntimeError):
    """A viewer is unavailable; the message names it, the reason, and an alternative."""


def executable() -> Path:
    """The Rerun program that came with the SDK, or the one named by RERUN_CLI_PATH. Raises `ViewerError`.

    Not the `rerun` script on PATH: that is a Python wrapper, whose death would leave the program behind.
    """
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise ViewerError("the Rerun program is missing (package rerun_cli); reinstall rerun-sdk")
    folder = Path(package.origin).parent
    suffix = ".exe" if sys.platform == "win32" else ""
    named = os.environ.get("RERUN_CLI_PATH")
    choices = [Path(named)] if named else [folder / "Rerun.app/Contents/MacOS/Rerun", folder / f"rerun{suffix}"]
    found = next((choice for choice in choices if choice.is_file()), None)
    if found is None:
        raise ViewerError(f"the Rerun program is missing: no file {choices[-1]}; reinstall rerun-sdk")
    return found


def display_problem() -> str | None:
    """Returns why no window can be opened here, or None."""
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set)"
    return None


def start(arguments: Sequence[str], ports: Sequence[int], *, outlive: bool) -> subprocess.Popen[bytes]:
    """Starts Rerun and returns when it listens on `ports`; raises `ViewerError` if it ends or does not listen in time.

    `outlive`: it stays when this process ends (a window in use); otherwise, on Linux, the kernel ends
    it with this process, however that dies.
    """
    command = [str(executable()), "--bind", LOOPBACK, *arguments]
    taken = [port for port in ports if listening(port)]
    if taken:
        raise ViewerError(f"port {taken[0]} of {LOOPBACK} is in use: another viewer? Choose another port")
    child = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        preexec_fn=None if outlive else partial(end_with_parent, signal.SIGTERM, os.getpid()),
    )
    deadline = time.monotonic() + _START_TIMEOUT
    while not all(listening(port) for port in ports):
        if child.poll() is not None:
            raise ViewerError(f"Rerun ended at once with exit code {child.returncode}: {' '.join(command)}")
        if time.monotonic() > deadline:
            stop(child)
            raise ViewerError(f"Rerun does not listen on {list(ports)} after {_START_TIMEOUT:g} s: {' '.join(command)}")
        time.sleep(0.05)
    return child


def stop(child: subprocess.Popen[bytes]) -> None:
    """Ends a child; returns within a few seconds."""
    child.terminate()
    try:
        child.wait(2.0)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait(2.0)


def listening(port: int, host: str = LOOPBACK, timeout: float = 1.0) -> bool:
    """Returns whether a server accepts connections there."""
    try:
        with socket.create_connection((host, port), timeout):
            return True
    except OSError:
        return False
