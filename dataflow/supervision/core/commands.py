"""Commands of the supervisor's core. The driver does it, in order; nothing here has an answer other than events."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dataflow.supervision.core.report import RunFailed, RunReport


@dataclass(frozen=True, slots=True)
class Spawn:
    """Start a process under this label; one that had it before has died."""

    label: str


@dataclass(frozen=True, slots=True)
class Send:
    """Send a message to a process. `replaces`: it makes queued ones of its kind obsolete."""

    label: str
    kind: str
    fields: Mapping[str, Any]
    replaces: bool = False


@dataclass(frozen=True, slots=True)
class Signal:
    """Send a signal to a process."""

    label: str
    number: int


@dataclass(frozen=True, slots=True)
class Announce:
    """Make the running graph known to tools, with the endpoints of these processes."""

    labels: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Withdraw:
    """The graph is no longer to be found by tools."""


@dataclass(frozen=True, slots=True)
class RunEnded:
    """The run is over: no process is left. Exactly one of the two is given."""

    report: RunReport | None
    failure: RunFailed | None


Command = Spawn | Send | Signal | Announce | Withdraw | RunEnded
