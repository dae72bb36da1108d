"""Makes a scenario that breaks a promise as small as possible while it still breaks one.

What happens is left out, one by one; then everything else is made plainer, one thing at a time, as long as a promise is
broken afterwards. A scenario that was made smaller runs in another order, so each step is tried on several machines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

from dataflow.graph import GraphError
from simulation.check import check
from simulation.drawn import without
from simulation.keeping import PLAIN
from simulation.run import Machine
from simulation.scenario import Scenario
from simulation.world import Violation

MACHINES = 3
"""Machines on which a smaller scenario is tried."""
MOST = 250
"""Runs that shrinking may take."""

Check = Callable[[Scenario, Path], object]
T = TypeVar("T")


def shrink(
    scenario: Scenario, folder: Path, violation: Violation, *, run: Check = check, most: int = MOST
) -> tuple[Scenario, str]:
    """Returns the smallest scenario found, and which promise it breaks."""
    return smallest(scenario, violation, _tries, lambda tried: run(tried, folder), most)


def smallest(
    found: T, violation: Violation, smaller: Callable[[T], Iterator[T]], run: Callable[[T], object], most: int
) -> tuple[T, str]:
    """Returns the smallest of what breaks a promise, and which, in `most` runs; `smaller` yields what to try next."""
    said, left = str(violation), most
    while True:
        for tried in islice(smaller(found), left):
            left -= 1
            try:
                run(tried)
            except Violation as broken:
                found, said = tried, str(broken)
                break
        else:
            return found, said


def _tries(scenario: Scenario) -> Iterator[Scenario]:
    for smaller in filter(_is_graph, _smaller(scenario)):
        yield from (_on_machine(smaller, attempt) for attempt in range(MACHINES))


def _is_graph(scenario: Scenario) -> bool:
    """Tells whether the streams that it records or leaves out are still there."""
    try:
        scenario.load()
    except GraphError:
        return False
    return True


def _on_machine(scenario: Scenario, attempt: int) -> Scenario:
    if not attempt:
        return scenario
    return replace(scenario, machine=replace(scenario.machine, seed=scenario.machine.seed + 100_003 * attempt))


def _smaller(scenario: Scenario) -> Iterator[Scenario]:
    """Yields what is a little plainer, the largest steps first."""
    for k in range(len(scenario.happenings)):
        yield replace(scenario, happenings=scenario.happenings[:k] + scenario.happenings[k + 1 :])
    for k in range(len(scenario.faults)):
        yield replace(scenario, faults=scenario.faults[:k] + scenario.faults[k + 1 :])
    machine, plain = scenario.machine, Machine(scenario.machine.seed)
    for name in ("room", "slow_disk", "socket_room", "ring_bytes", "pace", "preempt"):
        if getattr(machine, name) != getattr(plain, name):
            yield replace(scenario, machine=replace(machine, **{name: getattr(plain, name)}))
    if scenario.policy:
        yield replace(scenario, policy="")
        parts = scenario.policy.split(", ")
        for k in range(len(parts)):
            if "max" not in parts[k] and "backoff" not in parts[k]:
                yield replace(scenario, policy=", ".join(parts[:k] + parts[k + 1 :]))
    for keeping in (PLAIN, replace(scenario.keeping, states=""), replace(scenario.keeping, topics="")):
        if keeping != scenario.keeping:
            yield replace(scenario, keeping=keeping)
    for fewer in without(scenario.parts):
        yield replace(scenario, parts=fewer)
    for name, value in (("rate", None), ("work", 0.0), ("reading", 0.0), ("window", 256)):
        if getattr(scenario, name) != value:
            yield replace(scenario, **{name: value})  # type: ignore[arg-type]
    if not scenario.happenings and not scenario.faults and scenario.graph != "chain":
        yield replace(scenario, graph="chain", parts=())
    for count in (2, 4, scenario.count // 2, scenario.count - 1):
        if 0 < count < scenario.count:
            yield replace(scenario, count=count)
