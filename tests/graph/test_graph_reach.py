"""What is in front of an operator, and what is behind it, loops included."""

from __future__ import annotations

from dataflow.graph import load_text
from dataflow.graph.reach import downstream, upstream, with_makers

CHAIN = (("a", "cam/t"), ("b", "a/y"), ("c", "b/y"), ("aside", "a/y"))
GRAPH = load_text(
    "graph: g\noperators:\n  cam: {use: 'graph_loops:Tick'}\n"
    + "".join(f"  {name}: {{use: 'graph_loops:Same', inputs: {{x: {taken}}}}}\n" for name, taken in CHAIN)
)


def test_upstream_and_downstream_of_an_operator() -> None:
    assert upstream(GRAPH, ["c"]) == {"cam", "a", "b"}
    assert upstream(GRAPH, ["cam"]) == set()
    assert downstream(GRAPH, ["a"]) == {"b", "c", "aside"}
    assert downstream(GRAPH, ["b", "aside"]) == {"c"}


def test_an_operator_of_a_loop_depends_on_itself() -> None:
    loop = load_text(
        "graph: g\noperators:\n  tick: {use: 'graph_loops:Tick'}\n"
        "  sum: {use: 'graph_loops:Sum', inputs: {tick: tick/t, last: sum/total}}\n"
    )
    assert upstream(loop, ["sum"]) == {"tick", "sum"}
    assert downstream(loop, ["sum"]) == {"sum"}
    assert downstream(loop, ["tick"]) == {"sum"}


def test_producers_are_repeated_up_to_held_streams_and_never_sources() -> None:
    assert with_makers((), GRAPH, ["c"]) == {"a", "b", "c"}
    assert with_makers((), GRAPH, ["a"]) == {"a"}
    assert with_makers(GRAPH.nodes["a"].outputs.values(), GRAPH, ["c"]) == {"b", "c"}
    assert with_makers(GRAPH.nodes["b"].outputs.values(), GRAPH, ["c"]) == {"c"}
