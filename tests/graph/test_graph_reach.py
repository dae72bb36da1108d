"""What is in front of an operator, and what is behind it, loops included."""

from __future__ import annotations

from dataflow.graph import load_text
from dataflow.graph.reach import downstream, upstream, with_makers

CHECK = "{{use: 'operators.monitoring:ImageWatch', inputs: {{image: {}}}}}"
GRAPH = load_text(
    "graph: g\noperators:\n  cam: {use: 'operators.sources:SyntheticRgbd'}\n"
    + "".join(
        f"  {name}: {CHECK.format(taken)}\n"
        for name, taken in (("a", "cam/image"), ("b", "a/checked"), ("c", "b/checked"), ("aside", "a/checked"))
    )
)


def test_what_an_operator_depends_on_and_what_depends_on_it() -> None:
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


def test_makers_are_repeated_up_to_what_is_held_and_never_sources() -> None:
    image = GRAPH.nodes["a"].outputs["checked"]
    assert with_makers((), GRAPH, ["c"]) == {"a", "b", "c"}
    assert with_makers((image,), GRAPH, ["c"]) == {"b", "c"}
