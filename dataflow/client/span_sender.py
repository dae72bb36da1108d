"""Sends spans to a collector of OpenTelemetry over HTTP (OTLP in JSON), or into a file that one reads.

https://opentelemetry.io/docs/specs/otlp/#otlphttp
"""

from __future__ import annotations

import json
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable
from http.client import HTTPException
from pathlib import Path
from urllib.parse import urlsplit

AT_MOST = 20_000
"""Spans that wait; those that come then are lost."""
AGAIN_AFTER, AGAIN_AT_LAST = 0.5, 10.0
"""Seconds until a request is repeated: the first time, and at most."""
ANSWER_WITHIN = 5.0
REPEATED = frozenset((429, 502, 503, 504))
"""Answers after which the specification has a request repeated."""


class SpansRejected(Exception):
    """The collector does not take these spans, and would not later on."""


class SpanSender:
    """Sends on a separate thread; producers of spans never wait for the collector. `write`: sends one request, returns
    how many of its spans were refused; it raises `OSError` where it may be repeated, `SpansRejected` where not."""

    def __init__(self, write: Callable[[str], int], at_most: int = AT_MOST, again_after: float = AGAIN_AFTER) -> None:
        self._write, self._at_most, self._again_after = write, at_most, again_after
        self._waiting: deque[tuple[str, int]] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._until = float("inf")
        self._queued = 0
        self.sent = self.lost = 0
        """Spans that were taken, and those that were not."""
        self.reason = ""
        """Why sending failed the last time, or nothing."""
        self._thread = threading.Thread(target=self._run, name="spans", daemon=True)
        self._thread.start()

    def put(self, text: str, spans: int) -> None:
        """Takes a request with so many spans; too many that wait are lost."""
        with self._changed:
            if self._queued + spans > self._at_most:
                self.lost += spans
                self.reason = self.reason or "they come faster than they are taken"
                return
            self._waiting.append((text, spans))
            self._queued += spans
            self._changed.notify()

    def close(self, within: float) -> None:
        """Sends what waits, for so many seconds; the rest is lost."""
        with self._changed:
            self._closing, self._until = True, time.monotonic() + within
            self._changed.notify()
        self._thread.join(within + 2 * ANSWER_WITHIN)
        with self._changed:
            self.lost, self._queued = self.lost + self._queued, 0

    def _run(self) -> None:
        while (request := self._next()) is not None:
            self._send(*request)

    def _next(self) -> tuple[str, int] | None:
        with self._changed:
            while not self._waiting and not self._closing:
                self._changed.wait()
            return self._waiting.popleft() if self._waiting and time.monotonic() < self._until else None

    def _send(self, text: str, spans: int) -> None:
        pause, refused = self._again_after, spans
        while True:
            try:
                refused = self._write(text)
            except SpansRejected as error:
                self.reason = str(error)
            except (OSError, HTTPException) as error:
                self.reason = _reason_of(error)
                if self._waits(pause):
                    pause = min(2 * pause, AGAIN_AT_LAST)
                    continue
            break
        with self._changed:
            self._queued -= spans
            self.sent += spans - refused
            self.lost += refused

    def _waits(self, pause: float) -> bool:
        """Waits before another try; returns False where there is no time for one."""
        end = time.monotonic() + pause
        with self._changed:
            while (now := time.monotonic()) < min(end, self._until):
                self._changed.wait(min(end, self._until) - now)
        return time.monotonic() < self._until


def into_file(path: Path) -> Callable[[str], int]:
    """Returns what appends requests to a file, a line each. Raises OSError."""
    file = path.open("w", encoding="utf-8", buffering=1)

    def write(text: str) -> int:
        try:
            file.write(f"{text}\n")
        except OSError as error:
            raise SpansRejected(f"{path}: {error.strerror}") from None
        return 0

    return write


def to_collector(url: str) -> Callable[[str], int]:
    """Returns what posts requests to a collector; a URL without a path gets that of the specification. Raises
    ValueError for what is no URL of HTTP."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError(f"{url} is no URL of a collector, such as http://127.0.0.1:4318/v1/traces")
    target = url if parts.path.strip("/") else f"{parts.scheme}://{parts.netloc}/v1/traces"

    def write(text: str) -> int:
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(target, text.encode(), headers, method="POST")
        try:
            with urllib.request.urlopen(request, timeout=ANSWER_WITHIN) as answer:
                return _rejected(answer.read(65536))
        except urllib.error.HTTPError as error:
            with error:
                if error.code in REPEATED:
                    raise
                raise SpansRejected(f"{target} answers {error.code} {error.reason}") from None

    return write


def _rejected(body: bytes) -> int:
    """Returns how many spans of a request were not taken, by the answer."""
    try:
        answer = json.loads(body)
        return int(answer.get("partialSuccess", {}).get("rejectedSpans", 0))
    except (ValueError, TypeError, AttributeError):  # the answer has other content, but its code is that of success
        return 0


def _reason_of(error: Exception) -> str:
    reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
    return str(reason) or type(error).__name__
