"""The one engine: fed from the file in worker processes, without a network, with crashes named."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from dataflow.graph import Graph
from dataflow.graph.sections import Network
from dataflow.recording import Recording
from dataflow.reexecution.recorded_run import recorded_graph
from dataflow.supervision.core.report import RunFailed, Status
from dataflow.verification.verify import verify


def with_busy(kept: Path, use: str) -> Graph:
    with Recording(kept) as recording:
        graph = recorded_graph(recording)
    return replace(graph, nodes={**graph.nodes, "busy": replace(graph.nodes["busy"], use=f"watched_operators:{use}")})


def test_verification_opens_no_network_connection_whatever_the_graph_says(
    kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DATAFLOW_TEST_NO_NETWORK", str(os.getpid()))
    graph = replace(with_busy(kept, "Portless"), network=Network(listen=("tcp/0.0.0.0:17447",), scouting=True))

    report = verify(kept, graph=graph, jobs=2)

    assert report.identical, report.as_json()


def test_an_operator_that_ends_its_process_is_named_with_firing_and_stamp(kept: Path) -> None:
    with pytest.raises(
        RunFailed,
        match=r"operator 'busy' ended its process with code 7 in firing 10 \(fire\) at stamp 1700000000090000000",
    ) as raised:
        verify(kept, graph=with_busy(kept, "Fatal"), jobs=2)

    assert raised.value.operator == "busy"


def test_progress_is_shown_for_every_operator_and_both_times_are_told(kept: Path) -> None:
    seen: list[Status] = []

    report = verify(kept, jobs=2, watch=seen.append)

    assert seen[-1].operators["busy"].firings == 150
    assert set(seen[-1].operators) == {"look", "smooth", "busy", "tally"}
    assert set(seen[-1].process_of.values()) == {"worker 1", "worker 2"}
    assert report.total > report.wall > 0
