"""Faults of sources: what is done to their steps on the way out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from dataflow.chaos.plan import SECOND
from dataflow.messages.base import Message

Step = Mapping[str, Message]


class SourceFaults:
    """What is done to the steps of one source on their way out. `now` is in seconds, never going back."""

    def __init__(self) -> None:
        self._silent_until = 0.0
        self._flood: tuple[int, float] = (1, 0.0)
        self._shift = 0
        self._past: int | None = None

    def begin(self, kind: str, fields: Mapping[str, Any], now: float) -> None:
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
