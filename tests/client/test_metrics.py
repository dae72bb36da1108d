"""Metrics for Prometheus: what processes answer, as text, over HTTP on loopback."""

from __future__ import annotations

import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from prometheus_text import prometheus

from dataflow.client.metrics import CONTENT_TYPE, Metrics, MetricsServer, collect
from dataflow.client.processes import ProcessStatus
from dataflow.sync import NEVER
from dataflow.transport.registry import RunningGraph

STRANGE = 'a "b" \\ c\nd'


def test_every_figure_of_an_operator_is_a_sample() -> None:
    found = RunningGraph(STRANGE, "robot", 1, 0.0, (), 12.5, {})
    status = ProcessStatus(
        "process",
        {"camera": [7, 6, 2, 3_000_000_000, 5_000_000_000, 4_000_000_000], "idle": [0, 0, 0, 0, NEVER, 0]},
        {"camera": 3, "idle": 0},
        frozenset(),
        {"camera": {("image", "timeout"): 4}},
        {"camera": (0.25, 0.5)},
        silences={"camera": 0.125},
    )
    metrics = Metrics()

    metrics.add_graph(found, ["camera", "idle", "gone"], [status])

    read = prometheus(metrics.text())
    graph = {"graph": STRANGE, "run": "1"}
    assert read.pop("dataflow_graph_up") == [(graph, 1)]
    assert read.pop("dataflow_graph_started_seconds") == [(graph, 12.5)]
    up = [(labels["operator"], value) for labels, value in read.pop("dataflow_operator_up")]
    assert up == [("camera", 1), ("idle", 1), ("gone", 0)]
    assert read.pop("dataflow_waits_total") == [
        ({**graph, "operator": "camera", "input": "image", "what": "timeout"}, 4)
    ]
    assert {name: [(labels["operator"], value) for labels, value in samples] for name, samples in read.items()} == {
        "dataflow_firings_total": [("camera", 7), ("idle", 0)],
        "dataflow_messages_total": [("camera", 6), ("idle", 0)],
        "dataflow_dropped_total": [("camera", 2), ("idle", 0)],
        "dataflow_cpu_seconds_total": [("camera", 3), ("idle", 0)],
        "dataflow_call_seconds_total": [("camera", 4), ("idle", 0)],
        "dataflow_restarts_total": [("camera", 3), ("idle", 0)],
        "dataflow_event_time_seconds": [("camera", 5)],
        "dataflow_silence_seconds": [("camera", 0.125)],
        "dataflow_behind_clock_seconds": [("camera", 0.5)],
    }


def test_no_two_samples_have_the_same_labels(tmp_path: Path) -> None:
    metrics = Metrics()
    for pid, started in ((1, 12.5), (2, 12.5), (0, 12.5), (0, 13.5)):  # pid 0: on other machines
        found = RunningGraph("robot", "robot", pid, 0.0, (), started, {})
        status = ProcessStatus("p", {"camera": [7, 6, 2, 3, 5, 4]}, {"camera": 3}, frozenset(), {}, {})
        metrics.add_graph(found, ["camera"], [status])

    for text in (metrics.text(), collect([], [tmp_path, tmp_path])):
        series = [line.rpartition(" ")[0] for line in text.splitlines() if not line.startswith("#")]
        assert len(series) == len(set(series)) > 0


@pytest.fixture
def address() -> Iterator[str]:
    """Of a server that counts how often it is asked."""
    asked = iter(range(100))
    server = MetricsServer(lambda: f"# asked {next(asked)}\n", 0)
    thread = threading.Thread(target=server.serve)
    thread.start()
    yield f"http://127.0.0.1:{server.port}"
    server.close()
    thread.join(10)


def test_each_request_is_answered_with_the_figures_of_its_moment(address: str) -> None:
    for expected in (0, 1):
        with urllib.request.urlopen(f"{address}/metrics", timeout=10) as answer:
            assert answer.headers["Content-Type"] == CONTENT_TYPE
            assert answer.read().decode() == f"# asked {expected}\n"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{address}/other", timeout=10)


def test_a_port_that_is_taken_is_an_error(address: str) -> None:
    with pytest.raises(OSError, match="in use"):
        MetricsServer(lambda: "", int(address.rpartition(":")[2]))
