"""Which operators are asked for a step: those that woke, and those whose time has come; the last of the graph first."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from dataflow.execution.driver import Ready
from dataflow.execution.protocol import Runner


class Scripted(Runner):
    """A runner without an operator: has so many firings to make, then waits for a moment on the clock, if for any."""

    def __init__(self, number: int, log: list[int], clock: Clock) -> None:  # without what a process is asked for
        self.number, self.log, self.clock = number, log, clock
        self.work_left = 0
        self.until: float | None = None
        self.awake = True
        self.keeps_time = True

    def step(self) -> bool:
        self.log.append(self.number)
        if not self.work_left:
            if self.until is not None and self.until <= self.clock.now:
                self.until = None
            return False
        self.work_left -= 1
        if self.work_left or self.until is not None:
            self.wake()
        return True

    def next_due(self) -> float | None:
        return None if self.until is None else self.until - self.clock.now


@dataclass
class Clock:
    now: float = 0.0

    def __call__(self) -> float:
        return self.now


@dataclass
class Listed:
    """The same by brute force: a list of who is awake, and of when others are to be asked, all looked at each time."""

    log: list[int] = field(default_factory=list)
    awake: set[int] = field(default_factory=set)
    work: dict[int, int] = field(default_factory=dict)
    until: dict[int, float | None] = field(default_factory=dict)
    noted: dict[int, float] = field(default_factory=dict)

    def step(self, now: float) -> bool:
        due = {n for n, when in self.noted.items() if when <= now}
        for number in due:
            del self.noted[number]
        asked, self.awake = sorted(self.awake | due, reverse=True), set()
        worked = False
        for number in asked:
            self.log.append(number)
            when = self.until[number]
            if self.work[number]:
                worked = True
                self.work[number] -= 1
                if self.work[number] or when is not None:
                    self.awake.add(number)
                continue
            if when is not None and when <= now:
                self.until[number] = None
            if self.until[number] is None:
                self.noted.pop(number, None)
            else:
                self.noted[number] = when
        return worked

    def next_due(self, now: float) -> float | None:
        return max(0.0, min(self.noted.values()) - now) if self.noted else None


NUMBERS = st.integers(0, 4)
ACTIONS = st.one_of(
    st.tuples(st.just("give"), NUMBERS, st.integers(0, 3)),
    st.tuples(st.just("wait"), NUMBERS, st.none() | st.integers(0, 8)),
    st.tuples(st.just("pass"), st.just(0), st.integers(0, 4)),
    st.tuples(st.just("step"), st.just(0), st.just(0)),
    st.tuples(st.just("wake all"), st.just(0), st.just(0)),
)


@given(st.lists(ACTIONS, max_size=40))
def test_runners_are_asked_in_the_same_order_as_by_brute_force(actions: list[tuple[str, int, Any]]) -> None:
    clock, listed = Clock(), Listed()
    log: list[int] = []
    ready = Ready(clock)
    runners = [Scripted(number, log, clock) for number in range(5)]
    for runner in runners:
        ready.add(runner)
        listed.work[runner.number], listed.until[runner.number] = 0, None
    listed.awake = set(range(5))

    for what, number, value in [*actions, *[("step", 0, 0)] * 10]:
        runner = runners[number]
        if what == "give":
            runner.work_left += value
            listed.work[number] += value
            runner.wake()
            listed.awake.add(number)
        elif what == "wait":
            runner.until = listed.until[number] = None if value is None else clock.now + value
            runner.wake()
            listed.awake.add(number)
        elif what == "pass":
            clock.now += value
        elif what == "wake all":
            ready.wake_all()
            listed.awake = set(range(5))
        else:
            assert ready.step() == listed.step(clock.now)
        assert log == listed.log
        assert bool(ready.woken) == bool(listed.awake)
        assert ready.next_due() == listed.next_due(clock.now)
