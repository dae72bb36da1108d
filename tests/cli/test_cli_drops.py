"""`dataflow drops` as it is typed, on a run that lost something."""

from __future__ import annotations

import json
import re
from pathlib import Path

import held_runs
import pytest

SUPPORT = str(Path(held_runs.__file__).parent)


LOUD = """
import held_runs


class Loud(held_runs.Odometry):
    def setup(self):
        super().setup()
        print("what operators print")
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> str:
    faults = held_runs.Faults(still=[("odometry", 45, 55)])
    path = tmp_path_factory.mktemp("held") / "run.mcap"
    return str(held_runs.recorded(held_runs.graph(80), faults, path))


@pytest.mark.long
def test_drops_names_the_loss_its_cost_and_what_the_file_lacks(dataflow, run: str) -> None:
    told = dataflow("drops", run, "--worse", "end_error > 5", "--path", SUPPORT, "--budget", "60").stdout

    assert "1.000 s" in told
    assert "held/drive/step" in told
    assert "overflow" in told
    assert re.search(r"1 of \d+ losses \((\d+ \w+, )*\d+ \w+\): a smallest set", " ".join(told.split()))
    assert "a smallest set, not the only cause" in told
    assert "are not in the file" in told


@pytest.mark.long
def test_it_is_json_with_another_graph_and_settings(dataflow, run: str, tmp_path: Path) -> None:
    graph = tmp_path / "held.yaml"
    text = held_runs.TEXT.format(steps=80, score="Score")
    graph.write_text(text.replace("held_runs:Odometry", "loud_odometry:Loud"))
    (tmp_path / "loud_odometry.py").write_text(LOUD)
    folders = ("--path", SUPPORT, "--path", str(tmp_path))
    words = ("--graph", str(graph), "--set", "drive.steps=80", *folders, "--json")

    found = dataflow("drops", run, "--worse", "end_error > 5", *words)
    told = json.loads(found.stdout)

    assert "what operators print" in found.stderr
    assert [loss["stamp"] for loss in told["named"]] == [held_runs.STAMP + 10**9]
    assert told["minimal"] is True


def test_no_expression_is_refused(dataflow, run: str) -> None:
    told = dataflow("drops", run, "--worse", "end_error >", "--path", SUPPORT, code=2)

    assert "--worse end_error >: no Python expression" in told.stderr
