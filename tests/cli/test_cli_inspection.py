"""`check`, `show` and `operators`."""

from __future__ import annotations

import json
from pathlib import Path

FAULTY = """\
graph: faulty
namespace: test
operators:
  left: {use: "runtime_operators:Conter"}
"""


def test_check_reports_ok_or_locates_every_fault(dataflow, small: Path, tmp_path: Path) -> None:
    faulty = tmp_path / "faulty.yaml"
    faulty.write_text(FAULTY)

    assert "ok" in dataflow("check", small).stdout
    told = dataflow("check", faulty, small, code=1)
    assert f"{faulty}:4:" in told.stdout
    assert "did you mean 'Counter'?" in told.stdout
    assert "1 of 2 graphs cannot run" in told.stderr
    assert json.loads(dataflow("check", small, "--json").stdout) == {"ok": True, "problems": []}
    (problem,) = json.loads(dataflow("check", faulty, "--json", code=1).stdout)["problems"]
    assert (problem["file"], problem["line"]) == (str(faulty), 4)
    assert f"did you mean {small}?" in dataflow("check", small.with_name("smal.yaml"), code=2).stderr
    dataflow("check", small, "--set", "smooth.sleep=0.5")
    assert "no parameter 'nope'" in dataflow("check", small, "--set", "nope=1", code=1).stdout


def test_show_draws_the_graph_as_tree_mermaid_and_json(dataflow, small: Path) -> None:
    assert "in  x     In[FeatureVector] <- left/fast" in dataflow("show", small).stdout
    assert dataflow("show", small, "--mermaid").stdout.startswith("flowchart LR")
    assert json.loads(dataflow("show", small, "--json").stdout)["nodes"][0]["name"] == "left"
    assert "exclude each other" in dataflow("show", small, "--json", "--mermaid", code=2).stderr


def test_operators_are_listed_and_described(dataflow) -> None:
    assert "operators.cloud:CloudBuilder" in dataflow("operators").stdout.splitlines()
    assert "stride" in dataflow("operators", "CloudBuilder").stdout
    described = json.loads(dataflow("operators", "CloudBuilder", "--json").stdout)
    assert described["use"] == "operators.cloud:CloudBuilder"
    listed = json.loads(dataflow("operators", "--json").stdout)
    assert described in listed["operators"]


def test_an_unknown_operator_is_answered_with_the_nearest(dataflow) -> None:
    assert "did you mean 'CloudBuilder'?" in dataflow("operators", "CloudBilder", code=2).stderr
