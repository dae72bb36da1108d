"""`dataflow param` and `dataflow top` on a graph that runs."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from attached_run import AttachedRun
from prometheus_text import prometheus
from span_collector import collector

from dataflow.client.attach import find_running
from dataflow.client.metrics import collect
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.plan import RunPlan

GRAPH = """\
graph: tunable
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 1000000}}
  tuned: {use: runtime_operators:Tuned, inputs: {x: left/fast}}
  slow: {use: runtime_operators:Smooth, inputs: {x: left/fast}, params: {sleep: 0.1}, live: {queue: newest, size: 1}}
  other: {use: runtime_operators:Smooth, inputs: {x: left/fast}, process: far}
"""


class Tunable(AttachedRun):
    """A live run in a process each, which is recorded."""

    def __init__(self, folder: Path) -> None:
        path = folder / "tunable.yaml"
        path.write_text(GRAPH)
        self.recording = folder / "run.mcap"
        super().__init__(RunPlan(load_graph(path, live=True), live=True, record=self.recording))

    def process_of(self, label: str) -> psutil.Process:
        return psutil.Process(self.supervisor.pid_of(label))


class Shared:
    """The graph that most tests look at: begun by the first that asks, and anew where one has ended it."""

    def __init__(self, folders: pytest.TempPathFactory) -> None:
        self._folders = folders
        self._background: Tunable | None = None

    def begun(self) -> Tunable:
        if self._background is None:
            self._background = Tunable(self._folders.mktemp("tunable"))
        return self._background

    def end(self) -> None:
        if self._background is not None:
            self._background.end()
            self._background = None


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    made = Shared(tmp_path_factory)
    yield made
    made.end()


@pytest.fixture
def running(shared: Shared) -> Tunable:
    return shared.begun()


@pytest.fixture
def alone(shared: Shared, tmp_path: Path) -> Iterator[Tunable]:
    """A graph for one test, which may stop or end it; it is the only one that runs."""
    shared.end()
    background = Tunable(tmp_path)
    yield background
    if background.thread.is_alive():
        background.end()


@pytest.mark.usefixtures("running")
def test_a_parameter_is_set_acknowledged_and_read_back(dataflow) -> None:
    dataflow("param", "set", "tuned.factor", "1")
    assert dataflow("param", "get", "tuned.factor").stdout == "1.0\n"

    assert dataflow("param", "set", "tuned.factor", "2.5").stdout == "tuned.factor = 2.5\n"

    assert dataflow("param", "get", "tuned.factor").stdout == "2.5\n"
    assert json.loads(dataflow("param", "set", "tuned.factor", "3", "--json").stdout) == {
        "operator": "tuned",
        "name": "factor",
        "value": 3.0,  # as the operator took it
    }
    assert json.loads(dataflow("param", "get", "--json").stdout)["tuned"] == {"factor": 3.0}


@pytest.mark.usefixtures("running")
def test_all_values_are_read_and_those_that_can_change_listed(dataflow) -> None:
    told = dataflow("param", "get").stdout
    assert "slow.sleep  0.1\n" in told
    assert "left.count  1000000\n" in told
    assert dataflow("param", "get", "left").stdout.startswith("left.count  1000000\nleft.period  10000000\n")

    (row,) = json.loads(dataflow("param", "list", "--json").stdout)
    assert (row["parameter"], row["bounds"], row["doc"]) == ("tuned.factor", ">= 0, <= 10", "weight of what comes")
    assert "left.period" in dataflow("param", "list", "--all").stdout
    assert "did you mean 'factor'?" in dataflow("param", "get", "tuned.factr", code=2).stderr


@pytest.mark.usefixtures("running")
@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["tund.factor", "1"], 2, "no operator 'tund' runs: did you mean 'tuned'?"),
        (["tuned", "1"], 2, "'tuned' names no parameter: write tuned.NAME"),
        (["tuned.factor", "[1"], 2, "'[1' is no YAML value"),
        (["tuned.factor", "2001-01-99"], 2, "'2001-01-99' is no YAML value"),
        (["tuned.factor", "2001-01-01"], 2, "'2001-01-01' cannot be the value of a parameter"),
        (["tuned.factor", "9" * 30], 2, "a number of at most 64 bits"),
        (["tuned.factr", "1"], 1, "Tuned has no parameter 'factr'; those that can change: factor"),
        (["slow.sleep", "1"], 1, "Smooth.sleep cannot change while the graph runs; none of its parameters can"),
        (["tuned.factor", "11"], 1, "Tuned.factor: Input should be less than or equal to 10, got 11"),
        (["tuned.factor", "-1"], 1, "Tuned.factor: Input should be greater than or equal to 0, got -1"),
        (["tuned.factor", "much"], 1, "Tuned.factor: Input should be a valid number"),
        (["tuned.factor", "1", "--timeout", "0"], 2, "--timeout 0: expected seconds, more than 0"),
    ],
)
def test_invalid_parameter_value_is_refused_with_the_reason(dataflow, words: list[str], code: int, told: str) -> None:
    before = dataflow("param", "get", "tuned.factor").stdout

    assert told in " ".join(dataflow("param", "set", *words, code=code).stderr.split())

    assert dataflow("param", "get", "tuned.factor").stdout == before


@pytest.mark.usefixtures("running")
def test_values_are_dumped_as_yaml_and_loaded_again_as_far_as_they_differ(dataflow, tmp_path: Path) -> None:
    file = tmp_path / "tuned.yaml"
    before = dataflow("param", "get", "tuned.factor").stdout.strip()
    assert dataflow("param", "dump").stdout == f'"tuned":\n  factor: {before}\n'
    dataflow("param", "dump", "-o", file)
    assert "exists; name another file" in dataflow("param", "dump", file, code=2).stderr
    assert "both name what to write" in dataflow("param", "dump", file, "-o", file, code=2).stderr
    dataflow("param", "set", "tuned.factor", "4.5")

    assert dataflow("param", "load", file).stdout == f"tuned.factor = {before}\n"
    assert "already" in dataflow("param", "load", file).stderr
    assert dataflow("param", "dump", file, "--all", "--overwrite").stdout == ""
    assert "  period: 10000000\n" in file.read_text()
    assert "already" in dataflow("param", "load", file).stderr


@pytest.mark.usefixtures("running")
@pytest.mark.parametrize(
    ("text", "code", "told"),
    [
        ("tuned: {factr: 1}", 2, "'tuned' has no parameter 'factr': did you mean 'factor'?"),
        ("tund: {factor: 1}", 2, "no operator 'tund' runs: did you mean 'tuned'?"),
        ("tuned: 3", 2, "expected a mapping from operators to their parameters"),
        ("tuned: {factor: 11}", 1, "less than or equal to 10"),
        ("tuned: [", 2, "is no YAML value"),
    ],
)
def test_a_file_with_a_fault_is_refused(dataflow, tmp_path: Path, text: str, code: int, told: str) -> None:
    (tmp_path / "tuned.yaml").write_text(text)
    before = dataflow("param", "get", "tuned.factor").stdout

    assert told in " ".join(dataflow("param", "load", tmp_path / "tuned.yaml", code=code).stderr.split())

    assert dataflow("param", "get", "tuned.factor").stdout == before


def rows_of(outcome: Any) -> dict[str, dict[str, Any]]:
    return {row["operator"]: row for row in json.loads(outcome.stdout)["operators"]}


@pytest.mark.usefixtures("running")
def test_top_reports_rates_drops_load_and_processes(dataflow) -> None:
    rows = rows_of(dataflow("top", "--json"))

    assert list(rows) == ["left", "tuned", "slow", "other"]
    assert rows["tuned"]["state"] == rows["left"]["state"] == "running"
    assert 20 < rows["left"]["rate"] < 150  # 100 Hz, where the machine can
    assert rows["slow"]["state"] == "dropping"
    assert rows["slow"]["wall"] > 0.5
    assert rows["slow"]["load"] < 0.5  # it sleeps
    assert rows["slow"]["drop_rate"] > 5
    assert rows["tuned"]["restarts"] == 0
    assert rows["other"]["process"] == "far"
    assert 0 <= rows["tuned"]["lag"] < 1


@pytest.mark.usefixtures("running")
def test_top_prints_a_table(dataflow) -> None:
    told = dataflow("top", "--once", "--every", "0.3").stdout

    assert told.startswith("tunable  running for ")
    assert [text.split()[0] for text in told.splitlines()[1:6]] == ["operator", "left", "tuned", "slow", "other"]
    assert "expected seconds, 0.05 or more" in dataflow("top", "--every", "0", code=2).stderr


def test_spans_of_a_running_graph_reach_a_collector_with_their_causes(alone: Tunable, dataflow) -> None:
    with collector([(200, "{}")]) as (url, taken):

        def end_when_some_came() -> None:
            for _ in range(600):
                if len(spans_in(taken)) > 200:
                    break
                time.sleep(0.05)
            alone.end()

        ending = threading.Thread(target=end_when_some_came)
        ending.start()
        said = dataflow("spans", "--to", url).stderr
        ending.join(90)
    spans = spans_in(taken)

    assert f"{len(spans):,} spans to {url}; " in said
    by_id = {span["spanId"]: span for span in spans}
    parents = {(s["name"], by_id[p]["name"]) for s in spans if (p := s.get("parentSpanId")) in by_id}
    assert parents == {(f"{name} fire", "left fire") for name in ("tuned", "slow", "other")}
    with Recording(alone.recording) as recording:
        recorded = {(r.operator, r.wall_start) for name in ("tuned", "slow") for r in recorded_firings(recording, name)}
    live = {
        (s["name"].split()[0], int(s["startTimeUnixNano"])) for s in spans if s["name"] in ("tuned fire", "slow fire")
    }
    assert live <= recorded


def spans_in(taken: list[Any]) -> list[dict[str, Any]]:
    """All spans of the requests that a collector was sent."""
    return [
        span
        for _, _, body in list(taken)
        for resource in body["resourceSpans"]
        for scope in resource["scopeSpans"]
        for span in scope["spans"]
    ]


@pytest.mark.usefixtures("running")
def test_top_reports_latency_of_every_path(dataflow) -> None:
    paths = {(p["source"], p["sink"]): p for p in json.loads(dataflow("top", "--json").stdout)["latencies"]}

    assert set(paths) == {("left", "tuned"), ("left", "slow"), ("left", "other")}
    for path in paths.values():
        assert 0 < path["p50_ms"] <= path["p99_ms"]
    assert paths["left", "slow"]["costliest"] == "slow"
    assert paths["left", "slow"]["p50_ms"] > 50  # it sleeps for 100 ms at every firing
    assert "costs most" in dataflow("top", "--once", "--every", "0.3").stdout


@pytest.mark.usefixtures("running")
def test_unhealthy_graph_is_reported_with_reasons_and_exit_code(dataflow, tmp_path: Path) -> None:
    words = ["health", "--over", "0.5", "--free", "0", "--folder", tmp_path]
    assert dataflow(*words, "--losses", "1").stdout == "tunable is healthy: 4 operators\n"

    told = json.loads(dataflow(*words, "--rate", "left=1e6", "--free", "1e9", "--json", code=1).stdout)
    assert (told["graph"], told["healthy"]) == ("tunable", False)
    left, slow, disk = told["reasons"]
    assert left.startswith("left: fires at ")
    assert left.endswith(" Hz, less than 1e+06")
    assert slow.startswith("slow: drops ")
    assert disk.endswith("left, less than 1e+09 GB")
    assert "did you mean 'left'?" in dataflow(*words, "--rate", "lef=3", code=2).stderr
    assert "no graph 'other' runs on this machine" in dataflow(*words, "--graph", "other", code=2).stderr


@pytest.mark.usefixtures("running")
def test_metrics_are_those_of_the_operators() -> None:
    def firings() -> dict[str, float]:
        read = prometheus(collect([find_running("tunable")], []))
        return {labels["operator"]: value for labels, value in read["dataflow_firings_total"]}

    first = later = firings()
    deadline = time.monotonic() + 30
    while later["left"] == first["left"] and time.monotonic() < deadline:
        later = firings()

    assert list(first) == ["left", "tuned", "slow", "other"]
    assert all(later[name] >= number > 0 for name, number in first.items())
    assert later["left"] > first["left"]


@pytest.mark.long
def test_unresponsive_process_is_shown_until_it_resumes(dataflow, alone: Tunable) -> None:
    process = alone.process_of("tuned")
    process.send_signal(signal.SIGSTOP)
    try:
        rows = rows_of(dataflow("top", "--json", "--every", "0.1"))
        told = dataflow("param", "set", "tuned.factor", "7", "--timeout", "0.5", code=1).stderr
        missing = dataflow("param", "get", "--timeout", "0.5", code=1)
    finally:
        process.send_signal(signal.SIGCONT)

    assert (rows["tuned"]["state"], rows["tuned"]["note"]) == ("no answer", "its process does not answer")
    assert rows["left"]["state"] == "running"
    assert "no answer for 'tuned' within 0.5 s" in told
    assert "no answer for tuned within 0.5 s" in missing.stderr
    assert "slow.sleep" in missing.stdout
    assert dataflow("param", "set", "tuned.factor", "7", "--timeout", "30").stdout == "tuned.factor = 7.0\n"


@pytest.mark.long
def test_the_changes_stand_in_the_recording_and_top_ends_with_the_graph(dataflow, alone: Tunable) -> None:
    for value in ("2.5", "3"):
        dataflow("param", "set", "tuned.factor", value)
    threading.Timer(0.5, alone.supervisor.stop).start()
    told = dataflow("top", "--every", "0.2")
    alone.thread.join(60)

    assert "tunable has ended" in told.stderr
    lines = told.stdout.splitlines()
    assert [text for text in lines if "operator" in text] == lines[:1]  # one heading
    assert {text.split()[1] for text in lines[1:]} == {"left", "tuned", "slow", "other"}
    with Recording(alone.recording) as recording:
        changed = [r.detail["value"] for r in recorded_firings(recording, "tuned") if r.kind == "param"]
    assert changed == [2.5, 3.0]
    assert "no graph runs" in dataflow("top", code=2).stderr
