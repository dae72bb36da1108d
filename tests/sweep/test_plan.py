"""The tasks of a sweep: their keys hold whatever decides a result, and what cannot be read fails alone."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from dataflow.graph import load_text
from dataflow.graph.model import Graph
from dataflow.sweep import plan
from dataflow.sweep.plan import Code, Digests, SweepError, grid, sources_in, tasks_of

MODULE = """
import importlib

from gains.front import GAIN

from dataflow.messages import FeatureVector
from dataflow.operator import Out, Source


class Numbers(Source):
    out: Out[FeatureVector]
    command = ("./brightness",)

    def stream(self):
        importlib.import_module("late_gain")
        yield {"out": FeatureVector(stamp=1, vectors=[[GAIN]], model="m")}
"""
GRAPH = """
graph: swept
namespace: test
operators:
  numbers: {use: "swept_plainly:Numbers"}
"""


@pytest.fixture
def graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Graph:
    """A graph with an operator of a plain module, which imports a package beside it and names a program."""
    (tmp_path / "swept_plainly.py").write_text(MODULE)
    (tmp_path / "brightness").write_text("a program")
    (tmp_path / "late_gain.py").write_text("GAIN = 3\n")
    (tmp_path / "gains").mkdir()
    (tmp_path / "gains" / "front.py").write_text("GAIN = 2\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("swept_plainly", "gains", "gains.front"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return load_text(GRAPH)


def key(graph: Graph | None, tmp_path: Path) -> str:
    return Code(Digests(tmp_path / "none.json"), ()).of(graph)


@pytest.mark.parametrize("file", ["swept_plainly.py", "gains/front.py", "late_gain.py", "brightness"])
@pytest.mark.parametrize("known", [True, False])
def test_all_code_of_an_operator_counts(graph: Graph, tmp_path: Path, file: str, known: bool) -> None:
    """Of a graph that is not known, as one in a recording elsewhere, all operators here."""
    before = key(graph if known else None, tmp_path)

    with (tmp_path / file).open("a") as code:
        code.write("# another version\n")

    assert key(graph if known else None, tmp_path) != before


def test_operators_that_cannot_be_imported_here_fail_in_their_own_runs(graph: Graph, tmp_path: Path) -> None:
    gone = replace(graph, nodes={"gone": replace(graph.nodes["numbers"], use="not_here.at_all:Gone")})
    assert key(gone, tmp_path) != key(graph, tmp_path)


def test_packages_of_an_environment_count(graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    apart = load_text(GRAPH.replace('Numbers"', 'Numbers", env: old'))
    versions = iter(["1.26.4", "2.4.6"])
    monkeypatch.setattr(plan, "environment_of", lambda env: env)
    monkeypatch.setattr(plan, "packages_in", lambda env: {"numpy": next(versions)})

    assert key(apart, tmp_path) != key(apart, tmp_path)


def test_a_recording_that_cannot_be_read_is_a_task_beside_the_others(graph: Graph, tmp_path: Path) -> None:
    (tmp_path / "torn.mcap").write_bytes(b"hello")
    digests = Digests(tmp_path / "none.json")

    [task] = tasks_of("verify", sources_in([str(tmp_path)], digests), {(): None}, None, (), (), digests)

    assert task.source.name == "torn.mcap"


def test_a_graph_with_an_environment_runs_in_several_processes(graph: Graph, tmp_path: Path) -> None:
    (tmp_path / "one.mcap").write_bytes(b"hello")
    digests = Digests(tmp_path / "none.json")
    apart = load_text(f'{GRAPH}  besides: {{use: "swept_plainly:Numbers", env: old}}\n')

    [one], [several] = (
        tasks_of("replay", sources_in([str(tmp_path)], digests), {(): each}, "graph.yaml", (), (), digests)
        for each in (graph, apart)
    )

    assert "--one-process" in one.words
    assert "--one-process" not in several.words


def test_a_url_that_nothing_here_can_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SweepError, match="nope://bucket/runs cannot be read: Protocol not known"):
        sources_in(["nope://bucket/runs"], Digests(tmp_path / "none.json"))


def test_every_combination_comes_once_with_the_last_name_changing_fastest() -> None:
    assert grid(["a=1,2", "b.c=x, y"]) == [
        (("a", "1"), ("b.c", "x")),
        (("a", "1"), ("b.c", "y")),
        (("a", "2"), ("b.c", "x")),
        (("a", "2"), ("b.c", "y")),
    ]
    assert grid([]) == [()]


def test_a_comma_inside_brackets_or_quotes_belongs_to_the_value() -> None:
    assert grid(['classes=[cup, "a,b"],[chair],"x,y"']) == [
        (("classes", '[cup, "a,b"]'),),
        (("classes", "[chair]"),),
        (("classes", '"x,y"'),),
    ]


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["a"], "expected NAME=VALUE"),
        (["a="], "expected NAME=VALUE"),
        (["a=1,,2"], "expected NAME=VALUE"),
        (["=1"], "expected NAME=VALUE"),
        (["a=1", "a=2"], "a has values already"),
        (["a=1,2,1"], "a value stands there twice"),
    ],
)
def test_malformed_sweep_choice_is_refused(words: list[str], what: str) -> None:
    with pytest.raises(SweepError, match=what):
        grid(words)
