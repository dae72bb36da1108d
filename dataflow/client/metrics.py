"""Figures of running graphs in the text format of Prometheus (version 0.0.4), served over HTTP on loopback."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from dataflow.client.attach import graph_of
from dataflow.client.processes import ProcessStatus, processes_of
from dataflow.sync import FOREVER, NEVER
from dataflow.transport.registry import RunningGraph

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
ANSWER_WITHIN = 1.0
Labels = Mapping[str, str]

FAMILIES: Mapping[str, tuple[str, str]] = {
    "dataflow_graph_up": ("gauge", "1 while the graph runs."),
    "dataflow_graph_started_seconds": ("gauge", "When the run began, in seconds since the epoch."),
    "dataflow_operator_up": ("gauge", "1 if the operator's process answers."),
    "dataflow_firings_total": ("counter", "Calls of process(), or steps of a source."),
    "dataflow_messages_total": ("counter", "Messages sent."),
    "dataflow_dropped_total": ("counter", "Messages that reached no firing, or steps that a source did not send."),
    "dataflow_waits_total": ("counter", "Waits for an input that were given up (timeout), messages that came late."),
    "dataflow_cpu_seconds_total": ("counter", "CPU time of the operator's calls."),
    "dataflow_call_seconds_total": ("counter", "Wall time of the operator's calls."),
    "dataflow_restarts_total": ("counter", "Restarts of the operator."),
    "dataflow_event_time_seconds": ("gauge", "The stamp up to which the operator is done."),
    "dataflow_silence_seconds": ("gauge", "How long the operator has not fired, or is at its first call."),
    "dataflow_behind_clock_seconds": ("gauge", "How far a source that could wait is behind the clock."),
    "dataflow_disk_free_bytes": ("gauge", "Free space where the folder lies."),
}
"""Every family, with its type and its help."""


class Metrics:
    """Samples by family. Counters begin again when the process of an operator is restarted."""

    def __init__(self) -> None:
        self._samples: dict[str, list[tuple[Labels, float]]] = {}

    def add(self, family: str, value: float, **labels: str) -> None:
        self._samples.setdefault(family, []).append((labels, value))

    def add_graph(self, found: RunningGraph, operators: Iterable[str], statuses: Sequence[ProcessStatus]) -> None:
        """Adds a running graph by what its processes answer. The label `run` keeps runs of one graph apart:
        the process, or where that is on another machine, when it began."""
        labels = {"graph": found.name, "run": str(found.pid or found.started)}
        self.add("dataflow_graph_up", 1, **labels)
        self.add("dataflow_graph_started_seconds", found.started, **labels)
        told = {operator: status for status in statuses for operator in status.restarts}
        for name in operators:
            status = told.get(name)
            self.add("dataflow_operator_up", status is not None, **labels, operator=name)
            if status is not None:
                self._add_operator(name, status, {**labels, "operator": name})

    def _add_operator(self, name: str, status: ProcessStatus, labels: dict[str, str]) -> None:
        self.add("dataflow_restarts_total", status.restarts[name], **labels)
        if name in status.counts:
            firings, emitted, dropped, cpu, done, wall = status.counts[name]
            self.add("dataflow_firings_total", firings, **labels)
            self.add("dataflow_messages_total", emitted, **labels)
            self.add("dataflow_dropped_total", dropped, **labels)
            self.add("dataflow_cpu_seconds_total", cpu * 1e-9, **labels)
            self.add("dataflow_call_seconds_total", wall * 1e-9, **labels)
            if done not in (NEVER, FOREVER):
                self.add("dataflow_event_time_seconds", done * 1e-9, **labels)
        for (taken, what), number in status.waits.get(name, {}).items():
            self.add("dataflow_waits_total", number, **labels, input=taken, what=what)
        if name in status.silences and name not in status.ended:
            self.add("dataflow_silence_seconds", status.silences[name], **labels)
        if name in status.behind:
            self.add("dataflow_behind_clock_seconds", max(status.behind[name]), **labels)

    def text(self) -> str:
        """The exposition: every family that has samples, with its help and type."""
        lines = []
        for family, (kind, help_) in FAMILIES.items():
            if family in self._samples:
                lines += [f"# HELP {family} {help_}", f"# TYPE {family} {kind}"]
                lines += [f"{family}{_labels(labels)} {float(value)!r}" for labels, value in self._samples[family]]
        return "\n".join(lines) + "\n"


def _labels(labels: Labels) -> str:
    escaped = {n: v.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n") for n, v in labels.items()}
    return "{" + ",".join(f'{name}="{value}"' for name, value in escaped.items()) + "}"


def collect(graphs: Iterable[RunningGraph], folders: Iterable[Path]) -> str:
    """Returns the figures of running graphs, and of the disks that hold `folders`, as text."""
    metrics = Metrics()
    for found in graphs:
        with processes_of(found) as processes:
            processes.connected(len(found.endpoints), ANSWER_WITHIN)
            metrics.add_graph(found, graph_of(found).nodes, processes.statuses(ANSWER_WITHIN))
    for folder in dict.fromkeys(folders):
        if folder.exists():
            metrics.add("dataflow_disk_free_bytes", shutil.disk_usage(folder).free, folder=str(folder))
    return metrics.text()


class MetricsServer:
    """Answers `GET /metrics` on a port of loopback with what `collect` returns at that moment; 0: a free port. Raises
    `OSError` where the port is taken."""

    def __init__(self, collect: Callable[[], str], port: int) -> None:
        lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path.partition("?")[0] != "/metrics":
                    self.send_error(404, "the figures are at /metrics")
                    return
                with lock:
                    body = collect().encode()
                self.send_response(200)
                self.send_header("Content-Type", CONTENT_TYPE)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: Any) -> None:
                """Prints nothing: a scraper asks every few seconds."""

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]

    def serve(self) -> None:
        """Serves until `close` is called on another thread, or an exception such as Ctrl-C ends it."""
        try:
            self._server.serve_forever(poll_interval=0.1)
        finally:
            self._server.server_close()

    def close(self) -> None:
        """Ends `serve`."""
        self._server.shutdown()
