"""Reload of an operator: the new code replaces the old one whole, or not at all."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from firing_operators import Collector, Echo, entry, node, run_all

from dataflow.execution.live import LiveRunner
from dataflow.execution.recorded import RecordedRunner
from dataflow.execution.source import SourceRunner
from dataflow.graph.code import ReloadError, code_now, digest_of, store, stored_operator
from dataflow.graph.model import Live, Node, Restart
from dataflow.records.comparison import Verification
from dataflow.records.repetition import Repetition, look_at

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


PLAIN = "from offering_reload.sums import Sum\n"
LAZY = """\
from typing import TYPE_CHECKING

from dataflow.lazy import lazily

if TYPE_CHECKING:
    from offering_reload.sums import Sum
else:
    __getattr__, __dir__ = lazily(__name__, {"sums": ("Sum",)})
"""
IN_A_FUNCTION = """\
    def process(self, x):
        from step_of_reload import STEP
        self.state.total += STEP"""


def _late(code: str) -> str:
    """The code with its import in a function."""
    code = code.replace("from step_of_reload import STEP\n", "")
    return code.replace("    def process(self, x):\n        self.state.total += STEP", IN_A_FUNCTION)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, text in MODULES.items():
        _write(tmp_path, name, text)
    before = set(sys.modules)
    yield tmp_path
    for name in sys.modules.keys() - before:
        if "reload" in name:
            del sys.modules[name]


def _write(folder: Path, module: str, text: str) -> None:
    file = folder / f"{module.replace('.', '/')}.py"
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)
    importlib.invalidate_caches()


def _node(use: str) -> Node:
    return replace(node(Echo, {"x": [STREAM]}, Live("block", 16, {"x": 0}, restart=Restart(1))), use=use)


def _runner(use: str) -> tuple[LiveRunner, Collector]:
    """An operator after one firing."""
    collector = Collector()
    runner = LiveRunner(_node(use), collector, static=frozenset(), event_clock=lambda: 10**6)
    runner.setup()
    _fire(runner, 100)
    return runner, collector


@pytest.fixture
def running(folder: Path) -> tuple[LiveRunner, Collector]:
    """An operator of the code in `folder`, after one firing."""
    return _runner("sum_to_reload:Sum")


def _repeated(runner: LiveRunner, collector: Collector) -> Verification:
    """What re-execution by the records comes to."""
    repetition = Repetition(lambda: collector.records, stateless=False)
    look_at([repetition])
    given = [entry(STREAM, 100 * k + 100, k) for k in range(len(collector.messages))]
    inputs = {STREAM: {(e.incarnation, e.seq): e.digest for e in given}}
    again = RecordedRunner(runner.node, Collector(), static=frozenset(), repetition=repetition, inputs=inputs)
    again.setup()
    for each in given:
        again.push(STREAM, each)
        run_all(again)
    again.end(STREAM, None, "")
    run_all(again)
    assert again.result.verified == len(given)
    return again.result


def _codes(collector: Collector) -> list[Mapping[str, str]]:
    return [r.detail["code"] for r in collector.records if r.kind == "setup"]


def _fire(runner: LiveRunner, stamp: int) -> None:
    runner.push(STREAM, entry(STREAM, stamp, stamp // 100 - 1))
    run_all(runner)


@pytest.mark.parametrize(
    ("module", "text", "reason"),
    [
        ("step_of_reload", "STEP = \n", "SyntaxError"),
        ("sum_to_reload", "", "has no operator 'Sum'"),
        ("sum_to_reload", CODE.replace("    y: Out", "    z: Out"), "its outputs are declared otherwise now"),
        (
            "sum_to_reload",
            CODE.replace("(Operator)", "(Operator, merge=True)"),
            "its inputs are declared otherwise now",
        ),
        ("sum_to_reload", CODE + "\n    def setup(self):\n        1 / 0\n", "ZeroDivisionError"),
        ("sum_to_reload", CODE + "\nwhile True: pass\n", r"not over within 0\.05 s"),
        ("sum_to_reload", CODE + "\n    def setup(self):\n        while True: pass\n", r"not over within 0\.05 s"),
    ],
)
def test_unfit_reloaded_code_is_refused_and_the_old_continues(
    folder: Path,
    running: tuple[LiveRunner, Collector],
    module: str,
    text: str,
    reason: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("dataflow.execution.live.SET_UP_WITHIN", 0.05)
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


def test_reload_reports_whether_the_code_changed(folder: Path, running: tuple[LiveRunner, Collector]) -> None:
    runner, _ = running
    assert not runner.reload()["changed"]
    (folder / "step_of_reload.py").write_text("STEP = 20\n")
    assert runner.reload()["changed"]


def test_a_module_that_declares_messages_is_not_imported_again(
    folder: Path, running: tuple[LiveRunner, Collector], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, _ = running
    kind = type("Declared", (sys.modules["dataflow.messages"].Message,), {"__module__": "step_of_reload"})
    monkeypatch.setattr(sys.modules["step_of_reload"], "Declared", kind, raising=False)
    (folder / "step_of_reload.py").write_text("STEP = 2\n")

    with pytest.raises(ReloadError, match="'step_of_reload' declares message types"):
        runner.reload()


def test_state_unfit_for_reloaded_code_is_reset(folder: Path, running: tuple[LiveRunner, Collector]) -> None:
    runner, collector = running
    (folder / "sum_to_reload.py").write_text(CODE.replace("total", "sum_so_far"))

    outcome = runner.reload()
    _fire(runner, 200)

    assert outcome["state"].startswith("begun anew: StateError")
    assert collector.numbers == [1.0, 1.0]
    assert collector.kinds() == ["setup", "fire", "setup", "fire"]


def test_failed_operator_resumes_at_once_with_reloaded_code(
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


@pytest.mark.parametrize("package", [PLAIN, LAZY])
def test_an_operator_that_a_package_offers_is_reloaded_and_repeated(folder: Path, package: str) -> None:
    _write(folder, "offering_reload.__init__", package)
    _write(folder, "offering_reload.sums", CODE)
    runner, collector = _runner("offering_reload:Sum")

    _write(folder, "offering_reload.sums", CODE.replace("+= STEP", "+= 10 * STEP"))
    assert runner.reload()["state"] == "kept"
    _fire(runner, 200)

    assert collector.numbers == [1.0, 11.0]
    result = _repeated(runner, collector)
    assert (result.differing, result.code_changed) == (0, [])


def test_an_operator_without_a_file_is_not_reloaded(folder: Path, running: tuple[LiveRunner, Collector]) -> None:
    runner, _ = running
    (folder / "sum_to_reload.py").unlink()

    with pytest.raises(ReloadError, match="module 'sum_to_reload' is no file outside"):
        runner.reload()


def test_a_function_by_the_name_of_its_module_stays_one(folder: Path) -> None:
    _write(folder, "named_reload.__init__", "from named_reload.step import step\n")
    _write(folder, "named_reload.step", "def step():\n    return 1\n")
    code = CODE.replace("from step_of_reload import STEP", "from named_reload import step")
    _write(folder, "named_reload.sums", code.replace("STEP", "step()"))
    runner, collector = _runner("named_reload.sums:Sum")

    _write(folder, "named_reload.step", "def step():\n    return 7\n")
    runner.reload()
    _fire(runner, 200)

    assert collector.numbers == [1.0, 8.0]
    assert sys.modules["named_reload"].step() == 7
    assert sys.modules["named_reload"].sums is sys.modules["named_reload.sums"]


def test_an_operator_keeps_its_code_when_another_of_its_module_is_reloaded(folder: Path) -> None:
    first, _ = _runner("sum_to_reload:Sum")
    second, collector = _runner("sum_to_reload:Sum")
    before = _codes(collector)[0]
    (folder / "step_of_reload.py").write_text("STEP = 5\n")
    first.reload()
    for file in store().iterdir():
        file.unlink()

    second.restarts.failed()
    second.restarts.begun()
    second._start_again()
    _fire(second, 200)
    second.reload()
    _fire(second, 300)

    assert collector.numbers == [1.0, 1.0, 6.0]
    assert [code == before for code in _codes(collector)] == [True, True, False]
    assert {file.name for file in store().iterdir()} == set(before.values())


def test_a_source_keeps_its_code_when_an_operator_of_its_module_is_reloaded(folder: Path) -> None:
    feed = "\n\nclass Feed(Source):\n    y: Out[FeatureVector]\n\n    def stream(self):\n        yield value(1, STEP)\n"
    (folder / "sum_to_reload.py").write_text(CODE.replace("Out\n", "Out, Source\n") + feed)
    runner, _ = _runner("sum_to_reload:Sum")
    collector = Collector()
    made = replace(_node("sum_to_reload:Feed"), inputs={}, source=True)
    source = SourceRunner(made, collector, live=True)
    source.setup()
    (folder / "step_of_reload.py").write_text("STEP = 5\n")
    runner.reload()

    source.start_again()

    first, second = _codes(collector)
    assert first == second
    assert type(source.operator).stream.__globals__["STEP"] == 1


def test_a_module_that_a_function_imports_is_reloaded_and_recorded(folder: Path) -> None:
    (folder / "sum_to_reload.py").write_text(_late(CODE))
    runner, collector = _runner("sum_to_reload:Sum")

    (folder / "step_of_reload.py").write_text("STEP = 5\n")
    runner.reload()
    _fire(runner, 200)

    assert collector.numbers == [1.0, 6.0]
    assert [c["step_of_reload"] for c in _codes(collector)] == [digest_of(b"STEP = 1\n"), digest_of(b"STEP = 5\n")]
    result = _repeated(runner, collector)  # the function would import what is there now
    assert result.code_changed == ["step_of_reload"]


def test_code_that_was_not_imported_then_or_is_not_now_has_not_changed(folder: Path) -> None:
    for_types = "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from types_of_reload import Kind\n\n"
    (folder / "sum_to_reload.py").write_text(for_types + _late(CODE))
    (folder / "types_of_reload.py").write_text("Kind = int\n")
    runner, collector = _runner("sum_to_reload:Sum")
    assert "types_of_reload" not in _codes(collector)[0]

    importlib.import_module("types_of_reload")
    assert _repeated(runner, collector).code_changed == []
    del sys.modules["step_of_reload"]
    then = code_now(runner.node.operator, ["types_of_reload"]).digests
    del sys.modules["types_of_reload"]
    assert code_now(runner.node.operator, then).digests == then


@pytest.mark.parametrize("module", ["sum_to_reload", "os", "../home"])
def test_a_recording_does_not_choose_the_file_that_is_read(
    folder: Path, running: tuple[LiveRunner, Collector], module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[Path] = []

    def read_bytes(path: Path) -> bytes:
        read.append(path)
        return b""

    (folder / "other").write_text("1 / 0\n")
    monkeypatch.setattr(Path, "read_bytes", read_bytes)

    assert stored_operator(running[0].node, {module: str(folder / "other")}) is None
    assert folder / "other" not in read
