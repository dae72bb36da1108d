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


def recorded(folder: Path, record: str) -> Path:
    """A recording of a graph of two modules, which are loaded as long as the test runs."""
    for name in ("stays_here", "goes_away"):
        (folder / f"{name}.py").write_text(MODULE)
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
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
def test_a_class_that_is_gone_is_named_and_the_rest_is_identical(folder: Path) -> None:
    path = recorded(folder, "**")
    (folder / "goes_away.py").write_text(MODULE.replace("class Same", "class Renamed"))
    del sys.modules["goes_away"]
    importlib.invalidate_caches()

    report = verify(path)

    assert report.absent == {"away": "module 'goes_away' has no operator 'Same'"}
    assert verdicts(report) == {"after": "identical", "beside": "identical"}
    assert not report.identical


def test_the_command_names_it_and_ends_with_2(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "goes_away.py")

    told = CliRunner().invoke(app, ["verify", str(path), "--quiet"])

    assert told.exit_code == 2
    assert "away: it is not here (no module 'goes_away')" in " ".join(told.output.split())
    assert "not wholly verified" in told.output


@pytest.mark.long
def test_it_cannot_be_verified_alone(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "goes_away.py")

    with pytest.raises(ReplayError, match="'away' cannot be verified: it is not here: no module 'goes_away'"):
        verify(path, only=["away"])


@pytest.mark.long
def test_what_takes_messages_of_it_that_were_not_recorded_cannot_be_verified(folder: Path) -> None:
    path = recorded(folder, "src/**")
    delete(folder / "goes_away.py")

    report = verify(path)

    assert report.absent == {"away": "no module 'goes_away'"}
    assert verdicts(report) == {"after": "unverifiable", "beside": "identical"}
    assert next(v for v in report.operators if v.operator == "after").missing == "test/away/out"


def test_a_module_that_is_here_and_fails_to_import_is_an_error(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "goes_away.py")
    (folder / "goes_away.py").write_text("raise RuntimeError('half written')")
    importlib.invalidate_caches()

    with pytest.raises(GraphError, match="half written"):
        verify(path)


@pytest.mark.long
def test_an_operator_that_lacks_a_parameter_of_then_is_named_and_the_rest_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    for name, more in (("stays_here", ""), ("changes", '\n    gain: float = Param(1.0, doc="gain")\n')):
        text = MODULE.replace("Out, Source", "Out, Param, Source").replace("    x: In", f"{more}    x: In")
        (tmp_path / f"{name}.py").write_text(text)
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    graph = load_text("""
graph: test
operators:
  src: {use: "stays_here:Numbers"}
  less: {use: "changes:Same", params: {gain: 2.0}, inputs: {x: src/out}}
  after: {use: "stays_here:Same", inputs: {x: less/out}}
""")
    run(graph, placement="one_process", record=tmp_path / "run.mcap")
    (tmp_path / "changes.py").write_text(MODULE)
    sys.modules.pop("changes")
    importlib.invalidate_caches()

    report = verify(tmp_path / "run.mcap")

    assert report.absent == {"less": "changes:Same has no parameter 'gain' any more"}
    assert verdicts(report) == {"after": "identical"}


def test_where_no_operator_is_here_each_reason_is_given_once_with_its_operators(folder: Path) -> None:
    path = recorded(folder, "**")
    delete(folder / "stays_here.py")
    delete(folder / "goes_away.py")

    with pytest.raises(ReplayError) as caught:
        verify(path, only=["beside"])

    assert "no module 'stays_here' (src, after, beside); no module 'goes_away' (away)" in str(caught.value)
    assert str(caught.value).count("--path DIR names another folder") == 1
