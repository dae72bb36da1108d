"""Signals that ask a run or a verification to end."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

ONE_REQUEST = 0.2
"""Seconds within which a signal that comes again is the same request."""


@contextmanager
def interrupts(stop: Callable[[], None], clock: Callable[[], float] = time.monotonic) -> Iterator[None]:
    """Calls `stop` at Ctrl-C, SIGTERM and SIGHUP meanwhile (in the main thread; elsewhere they are left alone).

    `timeout`, or a shell that hangs up, sends one to the process and then to its group: that calls `stop` once. One
    that was ignored when this program began stays ignored: that is how `nohup` and background jobs ask for it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    heard: dict[int, float] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        last, heard[number] = heard.get(number, -ONE_REQUEST), clock()
        if heard[number] - last >= ONE_REQUEST:
            stop()

    asking = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    heeded = [number for number in asking if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handle) for number in heeded}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
