"""The status of a run while it goes on, its report at the end, and its failure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from dataflow.supervision.core.health import Health
from dataflow.sync import NEVER


@dataclass(frozen=True, slots=True)
class OperatorCounts:
    """Progress of one operator: counts so far, CPU time of its calls, the stamp it has reached, wall time of its calls.

    Times are in nanoseconds.
    """

    firings: int = 0
    emitted: int = 0
    dropped: int = 0
    cpu_ns: int = 0
    done: int = NEVER
    wall_ns: int = 0

    def after(self, base: OperatorCounts) -> OperatorCounts:
        """These counts and those of the process before."""
        return OperatorCounts(
            self.firings + base.firings,
            self.emitted + base.emitted,
            self.dropped + base.dropped,
            self.cpu_ns + base.cpu_ns,
            self.done,
            self.wall_ns + base.wall_ns,
        )


@dataclass(slots=True)
class Status:
    """Holds what a progress display needs; updated in place while the graph runs."""

    phase: str = "starting"
    waiting: tuple[str, ...] = ()
    """While starting: the processes that are not ready yet, or whose connections are not proven."""
    started: float = 0.0
    operators: dict[str, OperatorCounts] = field(default_factory=dict)
    drops: dict[str, Counter[tuple[str, str]]] = field(default_factory=dict)
    """By operator, how many messages were dropped by (input, reason); a source's input is ""."""
    waits: dict[str, Counter[tuple[str, str]]] = field(default_factory=dict)
    """By operator and (input, "timeout" or "late"): waits that were given up, and messages that came late."""
    process_of: dict[str, str] = field(default_factory=dict)
    first: int | None = None
    began: int | None = None
    """The first stamp that a source has given; `first` is known before, where sources can say it."""
    steps: int | None = None
    notes: list[str] = field(default_factory=list)
    health: list[Health] = field(default_factory=list)
    restarts: dict[str, int] = field(default_factory=dict)
    behind: dict[str, float] = field(default_factory=dict)
    """Seconds by which each source of a live run is behind the clock."""
    paused: bool = False
    """Sources, or the recording in their place, wait until they are let go on."""
    speed: float | None = None
    """Event time against the clock, as last requested while it runs; None: never requested, or as fast as it goes."""

    @property
    def covered(self) -> int:
        return min((c.done for c in self.operators.values()), default=NEVER)


Watch = Callable[[Status], None]
"""Is shown how a run fares, a few times a second."""


@dataclass(frozen=True, slots=True)
class RunReport:
    """The result of a run.

    `streams` maps each stream to (messages, digest); `drops` each operator to (input, reason, count) triples, those of
    processes that were restarted included, with the input "" for what a source has not sent; `summaries` holds what
    metrics sinks report; `wall` is in seconds from the release of the sources; `restarts` counts by operator.
    """

    graph: str
    streams: Mapping[str, tuple[int, str]]
    operators: Mapping[str, OperatorCounts]
    drops: Mapping[str, tuple[tuple[str, str, int], ...]]
    summaries: Mapping[str, Mapping[str, Any]]
    transport: Mapping[str, Mapping[str, int]]
    files: Mapping[str, Mapping[str, Any]]
    first: int | None
    last: int | None
    wall: float
    interrupted: bool
    notes: tuple[str, ...]
    restarts: Mapping[str, int] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    waits: Mapping[str, tuple[tuple[str, str, int], ...]] = field(default_factory=dict)
    """Each operator's (input, "timeout" or "late", count): waits that were given up, which drops nothing, and messages
    that came after what needed them was decided, of which those for a trigger are among the drops too."""
    namespace: str = ""

    def digests(self) -> dict[str, str]:
        return {stream: digest for stream, (_, digest) in sorted(self.streams.items())}


class RunFailed(RuntimeError):
    """The run ended early. `str()` is the first cause; `details` the operator's traceback or the process's last words.

    `interrupted`: it was asked to end.
    """

    def __init__(
        self, message: str, details: str = "", operator: str | None = None, *, interrupted: bool = False
    ) -> None:
        super().__init__(message)
        self.details, self.operator, self.interrupted = details, operator, interrupted

    @property
    def internal(self) -> bool:
        """Returns whether `details` is a traceback of the runtime's own code, which does not concern an operator."""
        return self.operator is None and self.details.startswith("Traceback")
