"""Whatever a graph file holds, it loads or is refused with places: the loader never fails in another way."""

from __future__ import annotations

import json

from hypothesis import given, settings
from hypothesis import strategies as st

from dataflow.graph import Graph, GraphError, load_bundle, load_text
from dataflow.graph.draw import mermaid, tree

SEED = """\
graph: g
namespace: robot1
params: {stride: 4, data: , folder: "${env:GRAPH_TEST_DIR:-x}"}
operators:
  camera: {use: "graph_operators:Camera", params: {path: ${folder}/a, rate: 15}}
  cloud:
    use: graph_operators:CloudBuilder
    inputs: {depth: camera/depth, image: camera/image, camera: "camera/inf$*"}
    params: {stride: ${stride}, mode: exact, window: 5ms}
    process: vision
    live: {queue: newest, size: 3, wait: {depth: 3ms}, memory: 1GB, restart: {max: 1, backoff: 1s}}
    sync: {tolerance: 3ms}
  inner: {use: inner.yaml, inputs: {picture: camera/image}, params: {n: 2}}
  odometry: {use: "graph_operators:Odometry", inputs: {image: camera/image, map: mapper/map}}
  mapper: {use: "graph_operators:Mapper", inputs: {cloud: cloud/cloud, pose: odometry/pose}, sync: {tolerance: 0s}}
  fuse: {use: "graph_operators:Fuse", inputs: {poses: [odometry/pose, inner/found]}}
record: {topics: ["camera/**"], exclude: [camera/depth]}
view: {hide: [camera/depth]}
network: {listen: [tcp/127.0.0.1:7447], shared_memory: false}
"""
INNER = """\
graph: inner
params: {n: 1}
inputs: {picture: TestPicture}
outputs: {found: odometry/pose}
operators:
  odometry: {use: "graph_operators:Odometry", inputs: {image: picture}}
"""
WORDS = [
    "", " ", "\n", "  ", ": ", "-", "{", "}", "[", "]", ",", "*", "**", "$*", "/", "&a ", "*a", "<<: ", "!x ", "'", '"',
    "${",
    "${stride}", "${nope}", "${env:NO}", "null", "~", "true", "-1", "0", "010", ".nan", "1e400", "é", "\x00", "\t", "#",
    "camera", "camera/image", "use", "inner.yaml", "graph.yaml", "@", "|", ">", "? ", "%", "---\n",
    "99999999999999999999",
]  # fmt: skip


def load_or_refuse(text: str, inner: str, words: list[str]) -> Graph | None:
    try:
        return load_text(text, files={"inner.yaml": inner}, settings=words)
    except GraphError as error:
        for problem in error.problems:
            assert problem.line >= 1
            assert problem.column >= 1
            assert problem.message
        return None


def edited(text: str, edits: list[tuple[float, int, str]]) -> str:
    for where, cut, word in edits:
        i = int(where * len(text))
        text = text[:i] + word + text[i + cut :]
    return text


EDITS = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 6), st.sampled_from(WORDS)), min_size=1, max_size=3
)
SETTINGS = st.lists(st.sampled_from(["stride=${x}", "a.b=1", "cloud.mode=[", "=", "inner.n=3"]), max_size=3)


def test_the_text_that_is_edited_loads() -> None:
    assert load_text(SEED, files={"inner.yaml": INNER}).nodes


@settings(max_examples=80, deadline=None)
@given(
    EDITS, EDITS, st.booleans(), st.lists(st.sampled_from(["stride=${x}", "a.b=1", "cloud.mode=[", "=", "inner.n=3"]))
)
def test_edited_graphs_load_or_are_refused(
    outer: list[tuple[float, int, str]], inner: list[tuple[float, int, str]], both: bool, words: list[str]
) -> None:
    graph = load_or_refuse(edited(SEED, outer), edited(INNER, inner) if both else INNER, words)
    if graph is not None:
        assert load_bundle(graph.bundle()) == graph
        assert Graph.from_json(json.loads(json.dumps(graph.to_json()))) == graph
        tree(graph)
        mermaid(graph)
