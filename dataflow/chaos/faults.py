"""Faults on purpose: of sources, whose steps are changed on the way out, and of operators, before they fire."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from dataflow.messages.base import Message
from dataflow.sync import Firing

Step = Mapping[str, Message]

SECOND = 1_000_000_000
TO_OPERATORS = ("raise", "hang", "slow", "leak")
TO_SOURCES = ("stop", "flood", "jump", "past")
TO_PROCESSES = ("kill", "freeze")
"""Kinds of faults, by what they are done to."""
HANG = 3600.0
"""Seconds that a planned hang lasts, unless it is ended."""


class InjectedFault(RuntimeError):
    """A failure that was asked for, to see what follows from it."""


class OperatorFaults:
    """Faults of one operator: a firing that fails, hangs or begins late, memory that is not given back."""

    def __init__(self, clock: Callable[[], float] | None = None, sleep: Callable[[float], None] | None = None) -> None:
        self._clock, self._sleep = clock or time.monotonic, sleep or time.sleep
        self._fail = False
        self._pause, self._until = 0.0, 0.0
        self._leaked: list[bytearray] = []

    def begin(self, kind: str, fields: Mapping[str, Any], now: float) -> None:
        """`raise` fails the next firing in place of the operator, `hang` never ends it, `slow` begins every firing late
        for a while, `leak` takes memory."""
        match kind:
            case "raise":
                self._fail = True
            case "hang":
                self._pause, self._until = HANG, now + HANG
            case "slow":
                self._pause, self._until = fields["by"], now + fields["span"]
            case "leak":
                noise = os.urandom(1 << 20)
                self._leaked += [bytearray(noise) for _ in range(fields["megabytes"])]  # others get a turn in between

    def before(self, firing: Firing) -> InjectedFault | None:
        """Pauses before a firing as planned; returns the error with which it is to fail, if any."""
        if self._pause and self._clock() < self._until:
            self._sleep(self._pause)
        if not self._fail or firing.kind == "finish":
            return None
        self._fail = False
        return InjectedFault("planned")


class SourceFaults:
    """Holds what is done to the steps of one source on their way out. `now` is in seconds, never going back."""

    def __init__(self) -> None:
        self._silent_until = 0.0
        self._flood: tuple[int, float] = (1, 0.0)
        self._shift = 0
        self._past: int | None = None
        self.begun = False
        """True once there was a fault: until then every step takes its own place."""

    def begin(self, kind: str, fields: Mapping[str, Any], now: float) -> None:
        self.begun = True
        match kind:
            case "stop":
                self._silent_until = now + fields["span"]
            case "flood":
                self._flood = (fields["factor"], now + fields["span"])
            case "jump":
                self._shift += round(fields["by"] * SECOND) * (-1 if fields["back"] else 1)
            case "past":
                self._past = -round(fields["by"] * SECOND)

    def apply(self, step: Step, now: float) -> Iterator[dict[str, Message]]:
        """The steps that take this one's place: none, itself, or several."""
        if now < self._silent_until:
            return
        if self._shift:
            step = _shifted(step, self._shift)
        if self._past is not None:
            past, self._past = self._past, None
            yield _shifted(step, past)
        factor, until = self._flood
        for k in range(factor if now < until else 1):
            yield _shifted(step, k) if k else dict(step)


def _shifted(step: Step, by: int) -> dict[str, Message]:
    return {port: message.replace(stamp=max(0, message.stamp + by)) for port, message in step.items()}
