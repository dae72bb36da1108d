"""Planned faults of an operator, before its firings."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from firing_operators import Collector, Echo, entry, node, run_all

from dataflow.chaos.faults import HANG, OperatorFaults
from dataflow.execution.failure import OperatorFailure
from dataflow.execution.live import LiveRunner
from dataflow.graph.model import Live, Restart
from dataflow.messages import FeatureVector
from dataflow.supervision.process_main import _report
from dataflow.sync import Firing


def test_a_planned_error_fails_one_firing_in_place_of_the_operator() -> None:
    faults = OperatorFaults()
    made = node(Echo, {"x": ["t/s/x"]}, Live("newest", 16, {"x": 0}, restart=Restart(max=1, backoff=0)))
    collector = Collector()
    runner = LiveRunner(made, collector, static=frozenset(), event_clock=lambda: 0, faults=faults)
    runner.setup()
    faults.begin("raise", {}, 0.0)
    for seq in range(2):
        runner.push("t/s/x", entry("t/s/x", 10 + seq, seq))
        run_all(runner)

    failed, _, fired = (r for r in collector.records[1:])
    assert (failed.outcome, failed.detail) == ("error", {"error": "InjectedFault: planned", "injected": True})
    assert (fired.incarnation, fired.outcome) == (1, "ok")


class Crashing(Echo):
    """Fails at its first message, in a library."""

    def process(self, x: FeatureVector) -> FeatureVector:
        np.linalg.inv(np.zeros((2, 2)))
        return x


def test_survived_failure_names_the_line_of_the_operator() -> None:
    made = node(Crashing, {"x": ["t/s/x"]}, Live("newest", 16, {"x": 0}, restart=Restart(max=1, backoff=0)))
    told: list[OperatorFailure] = []
    runner = LiveRunner(
        made,
        Collector(),
        static=frozenset(),
        operator=Crashing(),
        event_clock=lambda: 0,
        on_failure=lambda failure, pause: told.append(failure),
    )
    runner.setup()
    runner.push("t/s/x", entry("t/s/x", 10, 0))
    runner.step()

    (failure,) = told
    assert failure.file == __file__
    assert failure.line == Crashing.process.__code__.co_firstlineno + 1
    assert failure.where == f"{Path(__file__).name}:{failure.line}"


def test_a_failure_outside_of_any_operator_has_no_line() -> None:
    failure = OperatorFailure("n", "its timer", ValueError("no grid"))

    assert (failure.file, failure.line, failure.where) == ("", 0, "")


def test_slow_and_hanging_firings_end_with_their_time() -> None:
    now, slept = [0.0], list[float]()
    faults = OperatorFaults(clock=lambda: now[0], sleep=slept.append)

    faults.begin("slow", {"by": 0.2, "span": 1.0}, now[0])
    for now[0] in (0.5, 1.5):
        assert faults.before(Firing(0, "fire")) is None
    faults.begin("hang", {}, now[0])
    faults.before(Firing(0, "fire"))

    assert slept == [0.2, HANG]


def test_a_planned_error_spares_the_finish() -> None:
    faults = OperatorFaults()
    faults.begin("raise", {}, 0.0)

    assert faults.before(Firing(0, "finish")) is None
    assert faults.before(Firing(0, "fire")) is not None


class Importing(Echo):
    """Needs a package of an extra."""

    def setup(self) -> None:
        import cv2  # noqa: F401


def test_missing_package_of_an_extra_is_named_with_its_extra_but_recorded_as_raised(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    made = node(Importing, {"x": ["t/s/x"]}, Live("newest", 16, {"x": 0}))
    runner = LiveRunner(made, Collector(), static=frozenset(), operator=Importing(), event_clock=lambda: 0)
    reported: list[str] = []
    with pytest.raises(OperatorFailure, match=r"halted.*; it comes with: pip install 'robot-dataflow\[") as caught:
        runner.setup()
    _report(SimpleNamespace(send=lambda kind, **fields: reported.append(fields["summary"])), caught.value, "setup")

    assert str(caught.value).endswith(reported[0])
    assert "pip install" not in caught.value.summary


def test_hint_that_an_error_gives_itself_is_not_repeated() -> None:
    error = ImportError("no rays; it comes with: pip install 'robot-dataflow[sim]', but not everywhere")
    error.__cause__ = ModuleNotFoundError("No module named 'open3d'", name="open3d")

    assert str(OperatorFailure("robot", "setup()", error)).count("pip install") == 1
