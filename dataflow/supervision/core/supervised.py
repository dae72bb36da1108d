"""One process, as its supervisor sees it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

from dataflow.supervision.core.life import HAS_PROCESS, Life, Step, after
from dataflow.supervision.plan import ProcessPlan
from dataflow.sync import FOREVER, NEVER

WORDS_KEPT = 200


@dataclass(slots=True)
class Supervised:
    """State and news of one process. `since`: when it came into its state (steady s)."""

    plan: ProcessPlan
    since: float = 0.0
    life: Life = Life.STARTING
    attempt: int = 0
    """The number of processes that had this place before."""
    unseen: set[str] = field(default_factory=set)
    """Keys on which it has not seen a probe yet."""
    done: dict[str, int] = field(default_factory=dict)
    """The stamp up to which it is done: by operator, or for the recorder and the like of a live run by source."""
    report: dict[str, Any] | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    """The facts that it gave when it closed."""
    words: deque[str] = field(default_factory=lambda: deque(maxlen=WORDS_KEPT))
    cause: str = ""
    """Why it was killed or told to leave."""
    failed_in: dict[str, str] = field(default_factory=dict)
    """The place (`where`, such as "crashy.py:12") and the `traceback` of its failure, if it has reported one."""
    work: tuple[str, int, float] | None = None
    """The firing that took longer than a moment when it was last heard of: operator, stamp, seconds."""
    silent: bool = False
    """It gives no sign of life, and the others go on without it."""
    expected: int = 0
    """Counts how often it was asked to expect streams anew; an end reported before that has reached it is none."""
    begins: dict[str, int] = field(default_factory=dict)
    """The incarnations that its operators began with, where it took another's place."""
    hung_up: float | None = None
    """When it closed its channel."""

    @property
    def label(self) -> str:
        return self.plan.label

    @property
    def nodes(self) -> tuple[str, ...]:
        return self.plan.nodes

    @property
    def life_number(self) -> int:
        """Returns which process in this place it is; the first is 1."""
        return self.attempt + 1

    @property
    def is_sink(self) -> bool:
        return self.plan.sink is not None

    @property
    def reachable(self) -> bool:
        return self.life in HAS_PROCESS

    def take(self, step: Step, now: float) -> bool:
        """Changes the state; False, and nothing changes, when the step is out of turn."""
        state = after(self.life, step)
        if state is None:
            return False
        self.life, self.since = state, now
        return True

    def renew(self) -> None:
        """Forgets what belonged to the process before."""
        self.attempt += 1
        self.unseen.clear()
        self.words.clear()
        self.cause, self.report, self.work, self.failed_in = "", None, None, {}
        self.silent, self.hung_up = False, None

    def expect(self, now: float) -> None:
        """Takes back that it has ended: streams that it takes begin anew."""
        self.expected += 1
        if self.take(Step.GO_ON, now):
            self.report = None

    def end(self, report: dict[str, Any], now: float) -> bool:
        """Takes its report; False where it has not heard yet what it is to expect, or the report is out of turn."""
        if report.get("expected", 0) != self.expected or not self.take(Step.END, now):
            return False
        self.report = report
        return True

    def describe(self) -> str:
        what = ", ".join(self.nodes)
        return f"process {self.label!r}" + (f" (operators {what})" if what and what != self.label else "")

    def at_work(self) -> str:
        """Returns such as "process 'camera', camera at stamp 5 for 3 s"."""
        if self.work is None:
            return self.describe()
        operator, stamp, seconds = self.work
        return f"{self.describe()}, {operator} at stamp {stamp} for {seconds:.0f} s"

    def reached(self) -> str:
        """Returns such as "camera had reached stamp 5"."""
        return "; ".join(f"{n} had reached stamp {f}" for n, f in self.done.items() if f not in (NEVER, FOREVER))
