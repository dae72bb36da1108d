"""Writes the stack of each thread of a process to its log pipe.

The supervisor asks by a signal before it gives a process up, and a fault of native code (a segmentation fault, say)
writes them without a request. Both work while native code keeps the interpreter for itself.
"""

from __future__ import annotations

import faulthandler
import signal
from typing import Final

ASK: Final = signal.SIGUSR2
"""The signal by which a process is asked where it is."""
_WORDS: Final = 2
"""The descriptor to which words go."""


def ignore() -> None:
    """Ignores the question, in this process and in those that it forks until they can answer."""
    signal.signal(ASK, signal.SIG_IGN)


def answer() -> None:
    """Answers from now on; programs that this process starts are left as they are."""
    faulthandler.enable(_WORDS)
    faulthandler.register(ASK, _WORDS)
