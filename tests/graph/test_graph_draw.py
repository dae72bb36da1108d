"""Pictures of a graph show every operator, port and edge."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from dataflow.graph import Graph, load_text
from dataflow.graph.draw import mermaid, svg, tree
from dataflow.graph.layout import Box, Link, place

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def graph() -> Graph:
    return load_text("""\
graph: slam
namespace: robot1
operators:
  camera: {use: "graph_operators:Camera"}
  cloud:
    use: graph_operators:CloudBuilder
    inputs: {depth: camera/depth, image: camera/image, camera: camera/info}
    process: geometry
  odometry: {use: "graph_operators:Odometry", inputs: {image: camera/image, map: mapper/map}}
  mapper:
    use: graph_operators:Mapper
    inputs: {cloud: cloud/cloud, pose: odometry/pose}
    sync: {tolerance: 0s}
    process: geometry
  watchdog: {use: "graph_operators:Watchdog", inputs: {lens: camera/info, poses: odometry/pose}}
""")


def test_tree_names_hosts_operators_ports_types_and_streams(graph: Graph) -> None:
    out = io.StringIO()
    Console(file=out, width=160, color_system=None).print(tree(graph))
    text = out.getvalue()
    for node in graph.nodes.values():
        assert re.search(rf"── {node.name}  {node.use}", text)
    for host in graph.hosts():
        assert f"host {host}" in text
    assert re.search(r"in +depth +In\[TestDepth\] <- camera/depth", text)
    assert re.search(r"in +map +Sampled\[TestCloud\] <- mapper/map", text)
    assert re.search(r"in +poses +Batch\[TestPose\] <- odometry/pose", text)
    assert re.search(r"in +hint +Sampled\[TestPose\] <- \(left out\)", text)
    assert re.search(r"out +info +TestLens +static", text)


def test_mermaid_has_every_operator_and_edge_once(graph: Graph) -> None:
    text = mermaid(graph)
    ids = dict(re.findall(r'(n\d+)\["<b>(\w+)</b>', text))
    assert sorted(ids.values()) == sorted(graph.nodes)
    drawn = sorted(
        (ids[a], arrow, ids[b]) for a, arrow, b in re.findall(r'(n\d+) (-->|-\.->|==>)\|"[^"]+"\| (n\d+)', text)
    )
    arrows = {"in": "-->", "sampled": "-.->", "batch": "==>"}
    expected = sorted(
        (e.producer, arrows[graph.nodes[e.consumer].input_port(e.input).kind], e.consumer) for e in graph.edges()
    )
    assert drawn == expected
    assert text.count("subgraph") == text.count("    end\n") == 1


def test_svg_has_every_operator_port_and_edge(graph: Graph) -> None:
    root = ElementTree.fromstring(svg(graph))
    words = [t.text for t in root.iter(f"{SVG}text")]
    for node in graph.nodes.values():
        assert node.name in words
        assert all(port in words for port in (*node.inputs, *node.outputs))
    edges = [g for g in root.iter(f"{SVG}g") if g.get("class") == "edge"]
    assert len(edges) == len(list(graph.edges()))
    kinds = [e.find(f"{SVG}path").get("class") for e in edges]  # type: ignore[union-attr]
    assert (kinds.count("line sampled"), kinds.count("line batch")) == (3, 1)


def test_svg_is_the_same_every_time_and_escapes(graph: Graph) -> None:
    assert svg(graph) == svg(graph)
    assert "<script" not in svg(graph)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.data())
def test_layout_keeps_boxes_apart_and_lines_flow_right(count: int, data: st.DataObject) -> None:
    boxes = [
        Box(f"b{i}", 100, data.draw(st.sampled_from([60.0, 120.0])), {"in": 50.0}, {"out": 50.0}) for i in range(count)
    ]
    number = st.integers(0, count - 1)
    pairs = data.draw(st.lists(st.tuples(number, number), max_size=20, unique=True))
    links = [Link(f"b{a}", "out", f"b{b}", "in", f"b{a}") for a, b in pairs]
    layout = place(boxes, links)
    assert set(layout.back) == {link for link, (a, b) in zip(links, pairs, strict=True) if b <= a}
    frames = [(*layout.boxes[b.name], layout.widths[b.name], b.height) for b in boxes]
    for i, (x1, y1, w1, h1) in enumerate(frames):
        assert x1 >= 0
        assert y1 >= -1e-6
        assert y1 + h1 <= layout.height + 1e-6
        for x2, y2, w2, h2 in frames[:i]:
            assert x1 + w1 <= x2 or x2 + w2 <= x1 or y1 + h1 <= y2 + 1e-6 or y2 + h2 <= y1 + 1e-6
    for link in links:
        points = layout.routes[link]
        left, top = layout.boxes[link.producer]
        assert points[0] == (left + layout.widths[link.producer], top + 50.0)
        assert points[-1] == (layout.boxes[link.consumer][0], layout.boxes[link.consumer][1] + 50.0)
        if link not in layout.back:
            assert all(b[0] >= a[0] for a, b in pairwise(points))
