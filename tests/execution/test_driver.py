"""The loop that drives the operators of a process: what it does in a turn, and when nothing is left."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import FrameType

from firing_operators import Collector, Echo, entry, node

from dataflow.execution.driver import Driver, LocalEmitter
from dataflow.execution.feeds.feeding import Feeding
from dataflow.execution.runner import OperatorRunner
from dataflow.operator import Operator
from dataflow.sync import NEVER


class Fed:
    """A feed of messages on one stream."""

    def __init__(self, emitter: LocalEmitter, stamps: list[int]) -> None:
        self.emitter, self.left = emitter, list(enumerate(stamps))
        self.firings, self.last, self.ended = 0, NEVER, False

    def look_ahead(self) -> int | None:
        return self.left[0][1] if self.left else None

    def admit(self) -> tuple[int, int]:
        seq, self.last = self.left.pop(0)
        self.emitter.message("t/in", entry("t/in", self.last, seq))
        return 1, 0

    def promise(self) -> None:
        self.emitter.frontier("t/in", self.last)

    def finish(self, reason: str) -> None:
        self.ended = True
        self.emitter.end("t/in", self.last, reason)


def chain(driver: Driver, *names: str) -> None:
    """Operators that each repeat what the one before gives."""
    before = "t/in"
    for name in names:
        made = replace(node(Echo, {"x": [before]}), name=name, outputs={"y": f"t/{name}"})
        driver.add(OperatorRunner(made, LocalEmitter(driver), static=frozenset()))
        before = f"t/{name}"
    driver.set_up()


def drive(driver: Driver) -> int:
    turns = 0
    while driver.turn():
        turns += 1
    return turns


def test_a_promise_alone_goes_down_a_chain_of_operators_without_waiting_for_more() -> None:
    """Where no operator fires, what one promises may still be news to the next."""
    driver = Driver()
    chain(driver, "a", "b", "c")
    drive(driver)

    LocalEmitter(driver).frontier("t/in", 100)
    drive(driver)

    assert [runner.done for runner in driver.operators] == [100, 100, 100]


def test_a_step_of_the_feeds_is_worked_through_before_the_next_is_given() -> None:
    given: list[int] = []

    class Noting(LocalEmitter):
        def message(self, stream: str, entry: object) -> None:
            given.append(sum(runner.firings for runner in driver.operators))
            super().message(stream, entry)

    driver = Driver()
    chain(driver, "a", "b")
    driver.feeding.feeds.append(Fed(Noting(driver), [10, 20, 30]))

    drive(driver)

    assert given == [0, 2, 4]
    assert all(runner.ended for runner in driver.operators)


def test_feeds_wait_for_arrived_messages() -> None:
    arrived = [True]
    driver = Driver(Feeding(), lambda: arrived[0])
    chain(driver, "a")
    driver.feeding.feeds.append(Fed(LocalEmitter(driver), [10]))

    drive(driver)
    assert driver.operators[0].firings == 0
    arrived[0] = False
    drive(driver)
    assert driver.operators[0].firings == 1


def test_all_operators_are_closed_whatever_one_of_them_raises() -> None:
    closed: list[str] = []

    class Closes(Echo):
        def close(self) -> None:
            closed.append("closed")
            raise ValueError("no")

    driver = Driver()
    for name in ("a", "b", "c"):
        operator: Operator = Closes()
        made = replace(node(Echo, {"x": ["t/in"]}), name=name)
        driver.add(OperatorRunner(made, Collector(), static=frozenset(), operator=operator))

    failures = driver.close(but={"b"})

    assert [failure.operator for failure in failures] == ["a", "c"]
    assert len(closed) == 2


def calls_of_a_firing(messages: int = 40) -> float:
    """Calls of Python functions for each firing of a chain, once it runs, but for those that seed what is loaded."""
    driver = Driver()
    chain(driver, *"abcdefgh")
    driver.feeding.feeds.append(Fed(LocalEmitter(driver), [1000 * k for k in range(1, 2 * messages + 1)]))
    firings, calls = 8 * messages, 0

    def count(frame: FrameType, event: str, _: object) -> None:
        nonlocal calls
        calls += event == "call" and "/generators/" not in frame.f_code.co_filename

    while driver.operators[-1].firings < messages:
        driver.turn()
    sys.setprofile(count)
    try:
        while driver.operators[-1].firings < 2 * messages:
            driver.turn()
    finally:
        sys.setprofile(None)
    return calls / firings


def test_a_firing_takes_few_calls() -> None:
    """What is called for every firing slows every graph."""
    assert calls_of_a_firing() <= 42
