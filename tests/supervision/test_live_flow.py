"""Flow control of a live run: who is behind whom, and for whom sources wait."""

from __future__ import annotations

from dataflow.execution.feeds.window import Window
from dataflow.graph import Graph, load_text
from dataflow.supervision.core.live_flow import LiveFlow, sources_upstream, waited_for
from dataflow.sync import FOREVER, NEVER

GRAPH = """
graph: flow
namespace: test
operators:
  left: {use: runtime_operators:Counter}
  right: {use: runtime_operators:Counter}
  slow: {use: runtime_operators:Smooth, inputs: {x: left/fast}, live: {queue: newest, size: 1}}
  after: {use: runtime_operators:Smooth, inputs: {x: slow/mean}}
  exact: {use: runtime_operators:Smooth, inputs: {x: left/fast}}
  merge: {use: runtime_operators:Merge, inputs: {all: [exact/mean, right/fast]}}
  mix:
    use: runtime_operators:Mix
    inputs: {a: right/fast, b: right/slow, constant: left/constant, feedback: last/mean, recent: right/slow}
  last: {use: runtime_operators:Smooth, inputs: {x: mix/mixed}}
"""


def graph() -> Graph:
    return load_text(GRAPH)


def flow() -> LiveFlow:
    return LiveFlow(graph(), [[name] for name in graph().nodes])


def test_operators_live_on_the_sources_of_their_dynamic_streams() -> None:
    upstream = sources_upstream(graph())

    assert upstream["after"] == {"left"}
    assert upstream["merge"] == {"left", "right"}
    assert upstream["mix"] == upstream["last"] == {"right"}  # around the loop, without the constant


def test_sources_wait_for_those_that_drop_nothing_and_depend_on_none_that_does() -> None:
    assert waited_for(graph(), [[name] for name in graph().nodes]) == {"exact", "merge", "mix", "last"}


def test_dropping_operator_exempts_its_process_from_flow_control() -> None:
    processes = [["left", "slow", "mix"], ["right", "merge", "exact"], ["after"], ["last"]]

    assert waited_for(graph(), processes) == {"exact", "merge"}


def test_lag_of_an_operator_is_relative_to_its_sources() -> None:
    behind = flow()
    behind.reached("left", 100)
    behind.reached("right", 100)
    behind.reached("left", 500)
    behind.reached("right", 300)

    assert behind.lags("exact", 480) == (20, 20)
    assert behind.lags("merge", 290) == (10, 210)
    assert behind.lags("merge", FOREVER) == (0, 0)
    assert behind.lags("merge", NEVER) == (201, 401)  # all that was given
    assert (behind.given("merge"), behind.given("mix")) == (500, 300)
    assert behind.covered(["left", "right"], 30) == 470
    assert behind.covered(["right"], 30) == 270


def test_source_without_messages_causes_no_lag() -> None:
    behind = flow()
    behind.reached("left", 100)
    behind.reached("left", 900)
    behind.reached("right", NEVER)

    assert behind.lags("mix", NEVER) == (0, 0)
    assert behind.lags("merge", NEVER) == (0, 801)
    assert behind.covered(["right"], 0) == NEVER


def test_window_without_consumers_is_never_full() -> None:
    window = Window(2, 1000)
    window.add(1, 2, 10)
    assert window.full

    window.cover(FOREVER)
    window.add(2, 5, 10)
    assert not window.full

    window.cover(2)
    window.add(3, 2, 10)
    assert window.full
