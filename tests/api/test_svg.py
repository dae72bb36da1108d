"""Graphs as drawings."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from itertools import pairwise
from pathlib import Path

import pytest
from watched import Camera, Judge, Photometer

import dataflow
from dataflow.api.html import graph_svg, layers
from dataflow.graph import load_graph

SPACE = "{http://www.w3.org/2000/svg}"


def test_operators_are_drawn_after_their_inputs() -> None:
    graph = dataflow.Graph("watch").add("judge", Judge).add("meter", Photometer).add("camera", Camera)
    graph.connect("meter", image="camera/image").connect(
        "judge", brightness="meter/brightness", exposure="camera/exposure"
    )

    assert layers(graph.build()) == [["camera"], ["meter"], ["judge"]]


@pytest.mark.parametrize("file", ["synthetic_rgbd.yaml", "simulated_robot.yaml"])
def test_every_operator_and_every_edge_is_drawn_once_and_boxes_do_not_touch(repository: Path, file: str) -> None:
    graph = load_graph(repository / "graphs" / file)
    drawn = ElementTree.fromstring(graph_svg(graph))

    boxes = [tuple(int(box.get(k, "")) for k in ("x", "y", "width", "height")) for box in drawn.iter(f"{SPACE}rect")]
    assert len(boxes) == len(graph.nodes)
    assert len(list(drawn.iter(f"{SPACE}path"))) == len(list(graph.edges()))
    assert len({text.text for text in drawn.iter(f"{SPACE}text")} & set(graph.nodes)) == len(graph.nodes)
    for column in {x for x, *_ in boxes}:
        ranges = sorted((y, y + height) for x, y, _, height in boxes if x == column)
        assert all(above[1] < below[0] for above, below in pairwise(ranges))


def test_a_graph_in_a_notebook_shows_the_drawing_and_the_wiring() -> None:
    text = dataflow.Graph("watch").add("camera", Camera)._repr_html_()

    assert "<svg" in text
    assert "camera/image: Image" in text
