"""Stamps and frames that operators leave out are the same in every placement, live, replayed and verified."""

from __future__ import annotations

from pathlib import Path

import pytest

import dataflow
from dataflow.graph import load_graph
from dataflow.supervision.run import replay, run

GRAPH = """
graph: corner
namespace: test
operators:
  camera: {use: "operators.sources:SyntheticRgbd", params: {frames: 8, width: 16, height: 16}}
  corner: {use: runtime_operators:Corner, inputs: {image: camera/image}}
"""


@pytest.mark.long
def test_left_out_message_fields_are_completed_alike_in_every_placement(tmp_path: Path) -> None:
    file, path = tmp_path / "corner.yaml", tmp_path / "live.mcap"
    file.write_text(GRAPH, encoding="utf-8")
    graph = load_graph(file)

    reports = [
        dataflow.run(graph, record=tmp_path / "local.mcap").report,
        run(load_graph(file, live=True), live=True, placement="process_each", record=path),
        replay(path, placement="one_process"),
    ]

    for report in reports:
        told, left_out = (report.streams[f"test/corner/{port}"] for port in ("told", "left_out"))
        assert told == left_out == reports[0].streams["test/corner/told"]
        assert told[0] == 8
    assert dataflow.verify(path).identical
    assert dataflow.verify(tmp_path / "local.mcap").identical
