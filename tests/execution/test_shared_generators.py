"""Sources that draw from the global generators: the operators beside them must not notice."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping

import numpy as np
import pytest
from firing_operators import Collector, Dice, entry, node, run_all, value

from dataflow.execution.failure import OperatorFailure
from dataflow.execution.generators import shared_generators
from dataflow.execution.generators.shared_generators import CallTracker, SharedGenerators, Tripwire
from dataflow.execution.runner import OperatorRunner
from dataflow.execution.source import SourceRunner
from dataflow.messages import FeatureVector, Message
from dataflow.operator import Out, Source


class Noisy(Source):
    """Draws from the global generators for every message."""

    x: Out[FeatureVector]

    def stream(self) -> Iterator[Mapping[str, Message]]:
        for stamp in range(1, 6):
            yield {"x": value(stamp, random.random() + float(np.random.normal()))}


def source(*, live: bool = False) -> tuple[SourceRunner, Collector]:
    collector = Collector()
    runner = SourceRunner(node(Noisy, {}), collector, operator=Noisy(), live=live)
    runner.setup()
    return runner, collector


def beside(*, drawing: bool) -> list[float]:
    """What an operator makes that draws as well, with a source beside it on the same thread."""
    runner, given = source()
    collector = Collector()
    operator = OperatorRunner(node(Dice, {"x": ["t/s/x"]}, params={"shared": True}), collector, static=frozenset())
    operator.setup()
    for seq in range(5):
        if drawing:
            assert runner.look_ahead() is not None
            runner.admit()
        operator.push("t/s/x", entry("t/s/x", 10 + seq, seq))
        run_all(operator)
    assert len(given.messages) == (5 if drawing else 0)
    return collector.numbers


def test_an_operator_does_not_notice_a_source_that_draws() -> None:
    assert beside(drawing=True) == beside(drawing=False)


def test_random_draws_of_a_source_are_independent_of_other_operators() -> None:
    def draws(disturb: bool) -> list[float]:
        runner, collector = source()
        while runner.look_ahead() is not None:
            runner.admit()
            if disturb:
                np.random.seed(1)
                random.seed(1)
        return collector.numbers

    alone = draws(False)

    assert draws(True) == alone
    assert len(set(alone)) == 5


def test_a_live_source_that_draws_beside_operators_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    runner, _ = source(live=True)
    work = CallTracker()
    runner._tripwire = Tripwire(work)

    assert runner.take() is not None
    runner.check_draws()  # no operator fires in this process
    work.fires = True
    assert runner.take() is not None

    with pytest.raises(OperatorFailure, match=r"draw from self\.rng"):
        runner.check_draws()


def test_draws_while_an_operator_is_at_work_are_its_own() -> None:
    work = CallTracker()
    work.fires = True
    wire = Tripwire(work)

    with work:
        wire.set()
        random.random()
        wire.check("camera")
    wire.set()
    with work:
        random.random()
    wire.check("camera")
    wire.set()
    wire.check("camera")
    wire.set()
    np.random.random()
    with pytest.raises(SharedGenerators, match="camera draws"):
        wire.check("camera")


def test_every_call_of_an_operator_counts_as_work() -> None:
    before = shared_generators.CALLS_IN_PROGRESS.begun
    beside(drawing=False)

    assert shared_generators.CALLS_IN_PROGRESS.begun - before >= 7
    assert shared_generators.CALLS_IN_PROGRESS.begun == shared_generators.CALLS_IN_PROGRESS.ended
