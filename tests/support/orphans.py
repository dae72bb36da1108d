"""Processes that a test has left behind."""

from __future__ import annotations

import psutil


def end_orphans() -> list[str]:
    """Kills the running child processes of this one that are the project's; returns their command lines."""
    left = []
    for process in psutil.Process().children(recursive=True):
        try:
            command = " ".join(process.cmdline())
            if "-m dataflow." in command:
                process.kill()
                left.append(command)
        except psutil.NoSuchProcess:  # it has ended meanwhile, or ends: nothing of it runs
            continue
    return left
