"""Events that the supervisor's core takes, each with the moment at which it happened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dataflow.execution.feeds.playback import Action
from dataflow.recording.streams.logs import LogLine
from dataflow.records.black_box import RecoveredRecords


@dataclass(frozen=True, slots=True)
class Moment:
    """A clock value. `steady` (s) never goes back, stands still while the supervisor does not run, and times
    everything; `wall` (s since the epoch) is for stamps."""

    steady: float
    wall: float


class Event:
    """Anything that happens to a run."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class RunStarted(Event):
    """The run begins."""


@dataclass(frozen=True, slots=True)
class Tick(Event):
    """Time has passed."""


@dataclass(frozen=True, slots=True)
class Paused(Event):
    """The supervisor did not run for so many seconds: it, or the whole machine, was stopped. `uncounted` are
    those of them that the steady clock has not counted."""

    seconds: float
    uncounted: float = 0.0


@dataclass(frozen=True, slots=True)
class StopRequested(Event):
    """The user asks for an orderly end; a second time, for an end at once."""


@dataclass(frozen=True, slots=True)
class PlaybackRequested(Event):
    """The user asks to pause, resume, step what is not live, or to change its speed."""

    action: Action
    steps: int = 1
    speed: float | None = None


@dataclass(frozen=True, slots=True)
class TriggerRequested(Event):
    """The user asks the flight recorder to save its history."""

    text: str


@dataclass(frozen=True, slots=True)
class Aborted(Event):
    """The program around the core cannot go on."""

    why: str
    interrupted: bool = False


@dataclass(frozen=True, slots=True)
class Received(Event):
    """A process sent a message on its control channel."""

    label: str
    kind: str
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Printed(Event):
    """A process printed or logged something; `line` is how people are shown it."""

    label: str
    line: str
    log: LogLine | None = None
    """None for the second and later lines of one call of a logger."""


@dataclass(frozen=True, slots=True)
class NotReading(Event):
    """A process has not taken what was sent to it for `seconds`. `overflowed`: some of it is lost."""

    label: str
    seconds: float
    waiting: int
    overflowed: bool = False


@dataclass(frozen=True, slots=True)
class Disconnected(Event):
    """A process has closed its control channel."""

    label: str


@dataclass(frozen=True, slots=True)
class OrphansKilled(Event):
    """A process that ended, or one of several that ended at once, has left others, which were killed: each as "name
    (process N)"."""

    labels: tuple[str, ...]
    processes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RecordsRecovered(Event):
    """A process has ended, and these are the firing records that it left. Comes just before its `Exited`."""

    label: str
    remains: RecoveredRecords


@dataclass(frozen=True, slots=True)
class Exited(Event):
    """A process has ended. `code`: exit code, negative for a signal; None: unknown. Its last event."""

    label: str
    code: int | None


@dataclass(frozen=True, slots=True)
class LinkChanged(Event):
    """The link to another machine, on which these processes run, went down or came up again."""

    machine: str
    labels: tuple[str, ...]
    up: bool


@dataclass(frozen=True, slots=True)
class ClockMeasured(Event):
    """The clock of another machine is ahead of this one's by `offset` ns, which is at most half of `delay` ns wrong."""

    machine: str
    offset: int
    delay: int
