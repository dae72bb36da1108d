"""A failure that is about a file names the parameter whose value stands in it."""

from __future__ import annotations

from pathlib import Path

import pytest

import dataflow
from dataflow.cli.support.execution import _named_by
from dataflow.graph import load_graph
from dataflow.messages import FeatureVector
from dataflow.operator import Out, Param, Source
from dataflow.supervision.core.report import RunFailed


class Reader(Source):
    """Reads a file."""

    out: Out[FeatureVector]
    path: str = Param("imu", doc="the file")


@pytest.mark.parametrize(
    ("path", "text", "named"),
    [
        ("data/imu.csv", "no file data/imu.csv.", True),
        ("data/imu.csv", "no file 'data/imu.csv': is it mounted?", True),
        ("imu", "no file imu.csv", False),
        ("imu", "no file my_imu", False),
        ("imu", "no folder imu", True),
        ("/", "no folder /.", True),
    ],
)
def test_a_parameter_is_named_where_its_whole_value_stands_in_the_failure(path: str, text: str, named: bool) -> None:
    graph = dataflow.Graph("reads").add("reader", Reader, path=path).build()
    assert _named_by(RunFailed(text, operator="reader"), graph) == ("reader.path" if named else None)


OUTER = """
graph: outer
params: {other: none.csv, data: none.csv, count: 3}
operators:
  inner:
    use: inner.yaml
    params: {file: "${data}"}
"""
INNER = f"""
graph: inner
params: {{file: imu.csv, more: {{path: "${{file}}"}}}}
operators:
  reader: {{use: "{__name__}:Reader", params: "${{more}}"}}
"""


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ([], "data"),
        (["data=gone.csv"], "data"),
        (["inner.file=none.csv"], "inner/reader.path"),
        (["inner/reader.path=none.csv"], "inner/reader.path"),
    ],
)
def test_graph_parameter_that_fills_that_of_the_operator_is_named(
    tmp_path: Path, settings: list[str], named: str
) -> None:
    (tmp_path / "outer.yaml").write_text(OUTER)
    (tmp_path / "inner.yaml").write_text(INNER)
    graph = load_graph(tmp_path / "outer.yaml", settings=settings)
    file = graph.nodes["inner/reader"].params["path"]

    assert _named_by(RunFailed(f"no file {file}", operator="inner/reader"), graph) == named
