"""Reload of an operator: the new code replaces the old one whole, or not at all."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from firing_operators import Collector, Echo, entry, node, run_all

from dataflow.execution.live import LiveRunner
from dataflow.graph.code import ReloadError, store
from dataflow.graph.model import Live, Restart

STREAM = "t/s/x"
CODE = """\
from dataclasses import dataclass

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out
from firing_operators import value
from step_of_reload import STEP


@dataclass
class State:
    total: float = 0.0


class Sum(Operator):
    x: In[FeatureVector]
    y: Out[FeatureVector]
    state: State

    def process(self, x):
        self.state.total += STEP
        return value(x.stamp, self.state.total)
"""
MODULES = {"sum_to_reload": CODE, "step_of_reload": "STEP = 1\n"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, text in MODULES.items():
        (tmp_path / f"{name}.py").write_text(text)
    yield tmp_path
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture
def running(folder: Path) -> tuple[LiveRunner, Collector]:
    """An operator of the code in `folder`, after one firing."""
    made = replace(
        node(Echo, {"x": [STREAM]}, Live("block", 16, {"x": 0}, restart=Restart(1))), use="sum_to_reload:Sum"
    )
    collector = Collector()
    runner = LiveRunner(made, collector, static=frozenset(), event_clock=lambda: 10**6)
    runner.setup()
    _fire(runner, 100)
    return runner, collector


def _fire(runner: LiveRunner, stamp: int) -> None:
    runner.push(STREAM, entry(STREAM, stamp, stamp // 100 - 1))
    run_all(runner)


@pytest.mark.parametrize(
    ("module", "text", "reason"),
    [
        ("step_of_reload", "STEP = \n", "SyntaxError"),
        ("sum_to_reload", "", "has no operator 'Sum'"),
        ("sum_to_reload", CODE.replace("    y: Out", "    z: Out"), "its outputs are declared otherwise now"),
        ("sum_to_reload", CODE + "\n    def setup(self):\n        1 / 0\n", "ZeroDivisionError"),
    ],
)
def test_code_that_does_not_fit_is_refused_and_the_old_one_goes_on(
    folder: Path, running: tuple[LiveRunner, Collector], module: str, text: str, reason: str
) -> None:
    runner, collector = running
    modules = {name: sys.modules[name] for name in MODULES}
    (folder / f"{module}.py").write_text(text)

    with pytest.raises(ReloadError, match=reason):
        runner.reload()
    _fire(runner, 200)

    assert collector.numbers == [1.0, 2.0]
    assert collector.kinds() == ["setup", "fire", "fire"]
    assert {name: sys.modules[name] for name in MODULES} == modules
    assert not store().exists()


def test_a_module_that_declares_messages_is_not_imported_again(
    folder: Path, running: tuple[LiveRunner, Collector], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, _ = running
    kind = type("Declared", (sys.modules["dataflow.messages"].Message,), {"__module__": "step_of_reload"})
    monkeypatch.setattr(sys.modules["step_of_reload"], "Declared", kind, raising=False)
    (folder / "step_of_reload.py").write_text("STEP = 2\n")

    with pytest.raises(ReloadError, match="'step_of_reload' declares message types"):
        runner.reload()


def test_a_state_that_the_new_code_does_not_take_is_begun_anew(
    folder: Path, running: tuple[LiveRunner, Collector]
) -> None:
    runner, collector = running
    (folder / "sum_to_reload.py").write_text(CODE.replace("total", "sum_so_far"))

    outcome = runner.reload()
    _fire(runner, 200)

    assert outcome["state"].startswith("begun anew: StateError")
    assert collector.numbers == [1.0, 1.0]
    assert collector.kinds() == ["setup", "fire", "setup", "fire"]


def test_an_operator_that_has_failed_goes_on_with_new_code_at_once(
    folder: Path, running: tuple[LiveRunner, Collector]
) -> None:
    runner, collector = running
    (folder / "step_of_reload.py").write_text("STEP = None\n")
    runner.reload()
    _fire(runner, 200)
    assert runner.restarts.pending

    (folder / "step_of_reload.py").write_text("STEP = 5\n")
    assert runner.reload()["state"] == "none"
    _fire(runner, 300)

    assert collector.numbers == [1.0, 5.0]
    assert not runner.restarts.pending
