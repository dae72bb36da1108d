"""Pictures of a graph show every operator, port and edge."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from dataflow.graph import Graph, load_text
from dataflow.graph.draw import mermaid, tree


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


def test_tree_names_processes_operators_ports_types_and_streams(graph: Graph) -> None:
    out = io.StringIO()
    Console(file=out, width=160, color_system=None).print(tree(graph))
    text = out.getvalue()
    for node in graph.nodes.values():
        assert re.search(rf"── {node.name}  {node.use}", text)
    for process in graph.processes():
        assert f"process {process}" in text
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
