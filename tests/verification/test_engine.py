"""The one engine: fed from the file in worker processes, without a network, with crashes named."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import pytest

from dataflow.execution.threads import environment
from dataflow.graph import Graph, load_text
from dataflow.graph.sections import Network
from dataflow.recording import Recording
from dataflow.recording.streams.facts import machine_facts, record_elsewhere
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.supervision.core.report import RunFailed, Status
from dataflow.verification.facts import differing_facts
from dataflow.verification.verify import verify
from dataflow.verification.workers import job
from dataflow.verification.workers.board import Board
from dataflow.verification.workers.processes import Call


def test_verification_opens_no_network_connection(
    kept: Path, with_class: Callable[[str, str], Graph], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATAFLOW_TEST_NO_NETWORK", str(os.getpid()))
    graph = replace(with_class("busy", "Portless"), network=Network(listen=("tcp/0.0.0.0:17447",), scouting=True))

    report = verify(kept, graph=graph, jobs=2)

    assert report.identical, report.as_json()


def test_an_operator_that_ends_its_process_is_named_with_firing_and_stamp(
    kept: Path, with_class: Callable[[str, str], Graph]
) -> None:
    with pytest.raises(
        RunFailed,
        match=r"operator 'busy' ended its process with code 7 in call 9 \(fire\) at stamp 1700000000090000000",
    ) as raised:
        verify(kept, graph=with_class("busy", "Fatal"), jobs=2)

    assert raised.value.operator == "busy"


def test_progress_is_shown_for_every_operator(kept: Path) -> None:
    seen: list[Status] = []

    report = verify(kept, jobs=2, watch=seen.append)

    assert seen[-1].operators["busy"].firings == 150
    assert set(seen[-1].operators) == {"look", "smooth", "busy", "tally"}
    assert set(seen[-1].process_of.values()) == {"worker 1", "worker 2"}
    assert report.total > report.wall > 0


def test_opening_a_recording_and_reading_its_records_are_steps_of_a_worker(kept: Path) -> None:
    """A bound on the time between two steps then bounds no honest recording, however long it takes to be read."""
    steps: list[int] = []

    class Noting(Board):
        def begins(self, phase: str, operator: str) -> None:
            if phase == "setup" and not steps:
                steps.append(self.steps)
            super().begins(phase, operator)

    def here(calls: Sequence[Call], **options: Any) -> list[Any]:
        answers = []
        for call in calls:
            descriptor = os.memfd_create("board")
            answers.append(
                job.verify_part(msgpack.unpackb(msgpack.packb(call.request)), Noting(descriptor, call.operators))
            )
            os.close(descriptor)
        return answers

    report = verify(kept, jobs=1, workers=here)

    reads: list[None] = []
    with Recording(kept, watch=lambda: reads.append(None)):
        opening = len(reads)
    assert report.identical
    assert opening > 5
    assert steps[0] > opening  # and records, of chunks that are read but once


def test_several_environments_share_the_jobs(kept: Path) -> None:
    with Recording(kept) as recording:
        graph = recorded_graph(recording)
    envs = {"look": "one", "busy": "one", "smooth": "two", "tally": "two"}
    graph = replace(graph, nodes={name: replace(node, env=envs.get(name)) for name, node in graph.nodes.items()})

    def count(calls: Sequence[Call], **options: Any) -> list[Any]:
        raise RunFailed(", ".join(sorted(str(call.env) for call in calls)))

    with pytest.raises(RunFailed, match=r"^one, two$"):
        verify(kept, graph=graph, jobs=2, workers=count)


def test_facts_of_each_machine_of_a_run_are_compared() -> None:
    graph = load_text('graph: none\noperators: {in: {use: "dataflow.remote:Twist"}}')
    here = machine_facts(environment(1))
    robot = {record_elsewhere(group, "robot"): values for group, values in here.items() if group != "threads"}
    assert differing_facts({**here, **robot}, graph) == ()

    numpy = here["packages"]["numpy"]
    robot[record_elsewhere("packages", "robot")] = {**here["packages"], "numpy": "1.26.4"}

    assert differing_facts({**here, **robot}, graph) == (("packages numpy on robot", "1.26.4", numpy),)
