"""Recordings whose operators are deleted: the rest is verified, with what those made as it was recorded."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.app import app
from dataflow.graph import GraphError
from dataflow.graph.load import load_text
from dataflow.reexecution.recorded_run import ReplayError
from dataflow.supervision.run import run
from dataflow.verification.report import VerifyReport
from dataflow.verification.verify import verify

MODULE = """
from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator, Out, Source

class Numbers(Source):
    out: Out[FeatureVector]
    def stream(self):
        for k in range(5):
            yield {"out": FeatureVector(stamp=10**9 + k * 10**8, vectors=[[k]], model="")}

class Same(Operator):
    x: In[FeatureVector]
    out: Out[FeatureVector]
    def process(self, x):
        return x
"""


def verdicts(report: VerifyReport) -> dict[str, str]:
    return {v.operator: v.verdict for v in report.operators}


def write(folder: Path, **modules: str) -> None:
    """Puts modules of these texts into a folder, where they were not loaded before."""
    for name, text in modules.items():
        (folder / f"{name}.py").write_text(text)
        sys.modules.pop(name, None)
    importlib.invalidate_caches()


def recorded(folder: Path, record: str) -> Path:
    """A recording of a graph of two modules, which are loaded as long as the test runs."""
    write(folder, stays_here=MODULE, goes_away=MODULE)
    graph = load_text(f"""
graph: test
record: {{topics: ["{record}"]}}
operators:
  src: {{use: "stays_here:Numbers"}}
  away: {{use: "goes_away:Same", inputs: {{x: src/out}}}}
  after: {{use: "stays_here:Same", inputs: {{x: away/out}}}}
  beside: {{use: "stays_here:Same", inputs: {{x: src/out}}}}
""")
    run(graph, placement="one_process", record=folder / "run.mcap")
    return folder / "run.mcap"


def delete(module: Path) -> None:
    module.unlink()
    for cached in (module.parent / "__pycache__").glob(f"{module.stem}.*"):
        cached.unlink()
    del sys.modules[module.stem]
    importlib.invalidate_caches()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which modules are found."""
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.long
def test_deleted_class_is_named_and_the_rest_is_identical(folder: Path) -> None:
    path = recorded(folder, "**")
    write(folder, goes_away=MODULE.replace("class Same", "class Renamed"))

    report = verify(path)

    assert report.absent == {"away": "module 'goes_away' has no operator 'Same'"}
    assert verdicts(report) == {"after": "identical", "beside": "identical"}
    assert not report.identical


def test_command_names_deleted_module_and_exits_with_2(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "goes_away.py")

    told = CliRunner().invoke(app, ["verify", str(path), "--quiet"])

    assert told.exit_code == 2
    assert "away: it is not here (no module 'goes_away')" in " ".join(told.output.split())
    assert "not wholly verified" in told.output


@pytest.mark.long
def test_deleted_operator_cannot_be_verified_alone(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "goes_away.py")

    with pytest.raises(ReplayError, match="'away' cannot be verified: it is not here: no module 'goes_away'"):
        verify(path, only=["away"])


@pytest.mark.long
def test_consumer_of_unrecorded_messages_of_deleted_operator_is_unverifiable(folder: Path) -> None:
    path = recorded(folder, "src/**")
    delete(folder / "goes_away.py")

    report = verify(path)

    assert report.absent == {"away": "no module 'goes_away'"}
    assert verdicts(report) == {"after": "unverifiable", "beside": "identical"}
    assert next(v for v in report.operators if v.operator == "after").missing == "test/away/out"


def test_module_that_fails_to_import_is_an_error(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "goes_away.py")
    write(folder, goes_away="raise RuntimeError('half written')")

    with pytest.raises(GraphError, match="half written"):
        verify(path)


@pytest.mark.long
def test_operator_without_a_recorded_parameter_is_named_and_the_rest_verified(folder: Path) -> None:
    gained = MODULE.replace("Out, Source", "Out, Param, Source")
    gained = gained.replace("    x: In", '\n    gain: float = Param(1.0, doc="gain")\n    x: In')
    write(folder, stays_here=MODULE, changes=gained)
    graph = load_text("""
graph: test
operators:
  src: {use: "stays_here:Numbers"}
  less: {use: "changes:Same", params: {gain: 2.0}, inputs: {x: src/out}}
  after: {use: "stays_here:Same", inputs: {x: less/out}}
""")
    run(graph, placement="one_process", record=folder / "run.mcap")
    write(folder, changes=MODULE)

    report = verify(folder / "run.mcap")

    assert report.absent == {"less": "changes:Same has no parameter 'gain' any more"}
    assert verdicts(report) == {"after": "identical"}


def test_each_missing_module_is_named_once_with_its_operators(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "stays_here.py")
    delete(folder / "goes_away.py")

    with pytest.raises(ReplayError) as caught:
        verify(path, only=["beside"])

    assert "no module 'stays_here' (src, after, beside); no module 'goes_away' (away)" in str(caught.value)
    assert str(caught.value).count("--path DIR names another folder") == 1
