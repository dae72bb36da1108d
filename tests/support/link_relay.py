"""A TCP relay that delays, throttles, stalls and resets what passes: a bad link between two machines."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
import time
from collections import deque


class Relay:
    """Carries between clients of `listen` and `target`; `delay` (s) and `rate` (bytes/s, 0: any) may change."""

    def __init__(self, target: tuple[str, int], listen: tuple[str, int] = ("127.0.0.1", 0)) -> None:
        self._target = target
        self._server = socket.create_server(listen)
        self.port: int = self._server.getsockname()[1]
        self.delay, self.rate = 0.0, 0.0
        self.stalled = False
        self._closed = False
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def reset(self) -> None:
        """Breaks every connection (RST)."""
        pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for each in pair:
                with contextlib.suppress(OSError):
                    each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    each.close()

    def close(self) -> None:
        self._closed = True
        self._server.close()
        self.reset()

    def _accept(self) -> None:
        while not self._closed:
            try:
                ours, _ = self._server.accept()
            except OSError:
                return
            try:
                theirs = socket.create_connection(self._target, timeout=2)
            except OSError:
                ours.close()
                continue
            self._pairs.append((ours, theirs))
            for a, b in ((ours, theirs), (theirs, ours)):
                threading.Thread(target=self._carry, args=(a, b), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        waiting: deque[tuple[float, bytes]] = deque()
        with contextlib.suppress(OSError, ValueError):
            while not self._closed:
                full = len(waiting) > 64
                if self.stalled:
                    time.sleep(0.01)
                    continue
                if not full and select.select([source], [], [], 0.002)[0]:
                    data = source.recv(16384)
                    if not data:
                        break
                    waiting.append((time.monotonic() + self.delay, data))
                while waiting and (waiting[0][0] <= time.monotonic()) and not self.stalled:
                    data = waiting.popleft()[1]
                    sink.sendall(data)
                    if self.rate:
                        time.sleep(len(data) / self.rate)
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.close()
