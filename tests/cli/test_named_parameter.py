"""A failure that is about a file names the parameter whose value stands in it."""

from __future__ import annotations

import pytest

import dataflow
from dataflow.cli.support.execution import _named_by
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
