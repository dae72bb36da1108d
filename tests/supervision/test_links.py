"""Which processes are linked, and that each gets its ends of the links."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dataflow.graph import Graph, load_text
from dataflow.process.descriptors import Descriptors, take_descriptors
from dataflow.supervision.configs import configurations
from dataflow.supervision.links import Links, pairs_of
from dataflow.supervision.plan import RunPlan, process_plans

GRAPH = """\
graph: robot
namespace: test
operators:
  left: {use: runtime_operators:Counter}
  smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}}
  sum: {use: runtime_operators:Sum, inputs: {x: [smooth/mean]}}
"""


def plan(**options: Any) -> RunPlan:
    return RunPlan(load_text(GRAPH.replace("[smooth/mean]", "smooth/mean")), **{"placement": "process_each"} | options)


def test_a_process_is_linked_to_those_it_takes_from() -> None:
    made = plan()
    assert pairs_of(made.graph, process_plans(made)) == {
        ("left", "smooth"): ("test/left/fast",),
        ("smooth", "sum"): ("test/smooth/mean",),
    }


def test_a_recorder_is_linked_to_every_process_also_for_its_firing_records() -> None:
    made = plan(record=Path("run.mcap"))
    found = pairs_of(made.graph, process_plans(made))
    assert found["sum", "@recorder"] == ("test/@/firings/sum",)
    assert set(found["left", "@recorder"]) == {
        "test/@/firings/left",
        "test/left/constant",
        "test/left/fast",
        "test/left/slow",
    }


def test_process_sends_to_the_recorder_before_other_consumers() -> None:
    made = plan(record=Path("run.mcap"))
    takers = [consumer for producer, consumer in pairs_of(made.graph, process_plans(made)) if producer == "left"]
    assert takers == ["@recorder", "smooth"]


def test_one_process_needs_no_link() -> None:
    made = plan(placement="one_process")
    assert pairs_of(made.graph, process_plans(made)) == {}


def test_shared_configuration_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a hundred processes, all links would be looked for two hundred times."""
    asked = Counter[str]()

    def counted(name: str, function: Any) -> Any:
        return lambda *args: (asked.update([name]), function(*args))[1]

    monkeypatch.setattr(Graph, "to_json", counted("graph", Graph.to_json))
    monkeypatch.setattr("dataflow.supervision.configs.pairs_of", counted("links", pairs_of))
    made = plan(record=Path("run.mcap"))
    processes = process_plans(made)
    configurations(made, processes, dict.fromkeys(processes, "unixsock-stream//nowhere"))

    assert asked == {"graph": 1, "links": 1}


@contextmanager
def opened(made: RunPlan) -> Iterator[Mapping[str, Descriptors]]:
    """What each process of a run is handed, opened as it would open it."""
    processes = process_plans(made)
    links = Links(list(processes), pairs_of(made.graph, processes))
    configs = configurations(made, processes, dict.fromkeys(processes, "unixsock-stream//nowhere"))
    yield {label: take_descriptors(links.handed(label), configs[label][1]) for label in processes}
    links.close()


def test_messages_sent_on_a_link_arrive() -> None:
    with opened(plan(record=Path("run.mcap"))) as handed:
        for keys, link in handed["smooth"].outgoing:
            link.send(0, [keys[0].encode()], len(keys[0]))
        for label in ("sum", "@recorder"):
            arrived = [found for incoming in handed[label].incoming for found in incoming.take()]
            assert [key.encode() for key, _ in arrived] == [payload for _, payload in arrived]
            assert len(arrived) == 1
        assert [handed[label].box for label in handed] == [None] * 4


@pytest.mark.parametrize(("live", "kept"), [(False, 20_000), (True, 5_000)])
def test_only_links_to_operators_of_a_live_run_drop(live: bool, kept: int) -> None:
    with opened(plan(record=Path("run.mcap"), live=live)) as handed:
        for _, link in handed["smooth"].outgoing:
            for _ in range(20_000):
                link.send(0, [bytes(1000)], 1000)
        dropped = {len(keys): link.dropped for keys, link in handed["smooth"].outgoing}
        assert dropped[2] == 0  # the recorder takes messages and records
        assert 20_000 - dropped[1] >= kept
        assert bool(dropped[1]) == live


def test_too_many_links_are_closed_with_the_rest() -> None:
    before = len(os.listdir("/proc/self/fd"))
    links = Links(["a", "b"], {("a", "b"): ("x",)})
    assert len(os.listdir("/proc/self/fd")) == before + 4
    links.close()
    assert len(os.listdir("/proc/self/fd")) == before
