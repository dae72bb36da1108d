"""What differs between the machines of a run and the one that verifies its recording."""

from __future__ import annotations

from dataflow.execution.threads import environment
from dataflow.graph import load_text
from dataflow.recording.streams.facts import machine_facts, record_elsewhere
from dataflow.verification.facts import differing_facts

GRAPH = load_text('graph: none\noperators: {in: {use: "dataflow.remote:Twist"}}')


def test_facts_of_each_machine_of_a_run_are_compared() -> None:
    here = machine_facts(environment(1))
    robot = {record_elsewhere(group, "robot"): values for group, values in here.items() if group != "threads"}
    assert differing_facts({**here, **robot}, GRAPH) == ()

    numpy = here["packages"]["numpy"]
    robot[record_elsewhere("packages", "robot")] = {**here["packages"], "numpy": "1.26.4"}

    assert differing_facts({**here, **robot}, GRAPH) == (("packages numpy on robot", "1.26.4", numpy),)
