"""`dataflow param` and `dataflow top` on a graph that runs."""

from __future__ import annotations

import io
import json
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from rich.console import Console

from dataflow.cli.board import Board, Sample, heading, line, shown
from dataflow.client.attach import find_running
from dataflow.client.processes import ProcessStatus
from dataflow.graph import load_graph, load_text
from dataflow.graph.model import Graph
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.report import RunReport
from dataflow.supervision.supervisor import Supervisor
from dataflow.sync import NEVER
from dataflow.transport.registry import RunningGraph

GRAPH = """\
graph: tunable
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 1000000}}
  tuned: {use: runtime_operators:Tuned, inputs: {x: left/fast}}
  slow: {use: runtime_operators:Smooth, inputs: {x: left/fast}, params: {sleep: 0.1}, live: {queue: newest, size: 1}}
  other: {use: runtime_operators:Smooth, inputs: {x: left/fast}, process: far}
"""


class Background:
    """A live run on a thread of its own, in a process each, until it is told to stop."""

    def __init__(self, folder: Path) -> None:
        path = folder / "tunable.yaml"
        path.write_text(GRAPH)
        self.recording = folder / "run.mcap"
        graph = load_graph(path, live=True)
        self.supervisor = Supervisor(RunPlan(graph, live=True, record=self.recording))
        self.reports: list[RunReport] = []
        self.thread = threading.Thread(target=lambda: self.reports.append(self.supervisor.run()))
        self.thread.start()
        find_running("tunable", wait=30)

    def process_of(self, label: str) -> psutil.Process:
        return psutil.Process(self.supervisor.pid_of(label))

    def end(self) -> RunReport:
        self.supervisor.stop()
        self.thread.join(60)
        (report,) = self.reports
        return report


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Background]:
    background = Background(tmp_path_factory.mktemp("tunable"))
    yield background
    if background.thread.is_alive():
        background.end()


@pytest.mark.usefixtures("running")
def test_a_parameter_is_set_acknowledged_and_read_back(dataflow) -> None:
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
def test_what_cannot_be_set_is_refused_with_the_reason(dataflow, words: list[str], code: int, told: str) -> None:
    before = dataflow("param", "get", "tuned.factor").stdout

    assert told in " ".join(dataflow("param", "set", *words, code=code).stderr.split())

    assert dataflow("param", "get", "tuned.factor").stdout == before


@pytest.mark.usefixtures("running")
def test_a_parameter_that_there_is_not_is_answered_with_the_nearest(dataflow) -> None:
    assert "did you mean 'factor'?" in dataflow("param", "get", "tuned.factr", code=2).stderr


@pytest.mark.usefixtures("running")
def test_values_are_dumped_as_yaml_and_loaded_again_as_far_as_they_differ(dataflow, tmp_path: Path) -> None:
    file = tmp_path / "tuned.yaml"
    before = dataflow("param", "get", "tuned.factor").stdout.strip()
    assert dataflow("param", "dump").stdout == f'"tuned":\n  factor: {before}\n'
    dataflow("param", "dump", file)
    assert "exists; name another file" in dataflow("param", "dump", file, code=2).stderr
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
def test_top_tells_rates_drops_load_and_processes(dataflow) -> None:
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


@pytest.mark.usefixtures("running")
def test_top_tells_the_latency_of_every_path_of_the_last_seconds(dataflow) -> None:
    paths = {(p["source"], p["sink"]): p for p in json.loads(dataflow("top", "--json").stdout)["latencies"]}

    assert set(paths) == {("left", "tuned"), ("left", "slow"), ("left", "other")}
    for path in paths.values():
        assert 0 < path["p50_ms"] <= path["p99_ms"]
    assert paths["left", "slow"]["costliest"] == "slow"
    assert paths["left", "slow"]["p50_ms"] > 50  # it sleeps for 100 ms at every firing
    assert "costs most" in dataflow("top", "--once", "--every", "0.3").stdout


def test_a_process_that_does_not_answer_is_shown_so_and_a_change_waits_for_it(dataflow, running: Background) -> None:
    """The last test of the file but one: the process is stopped for a moment."""
    process = running.process_of("tuned")
    process.send_signal(signal.SIGSTOP)
    try:
        rows = rows_of(dataflow("top", "--json", "--every", "0.1"))
        told = dataflow("param", "set", "tuned.factor", "7", "--timeout", "0.5", code=1).stderr
        missing = dataflow("param", "get", "--timeout", "0.5", code=1)
    finally:
        process.send_signal(signal.SIGCONT)

    assert (rows["tuned"]["state"], rows["tuned"]["note"]) == ("no answer", "its process does not answer")
    assert rows["left"]["state"] == "running"
    assert "nobody answered for 'tuned' within 0.5 s" in told
    assert "nobody answered for tuned within 0.5 s" in missing.stderr
    assert "slow.sleep" in missing.stdout


def test_the_changes_stand_in_the_recording_and_top_ends_with_the_graph(dataflow, running: Background) -> None:
    """The last test of the file: it ends the graph."""
    threading.Timer(0.5, running.supervisor.stop).start()
    told = dataflow("top", "--every", "0.2")
    running.thread.join(60)

    assert "tunable has ended" in told.stderr
    lines = told.stdout.splitlines()
    assert [text for text in lines if "operator" in text] == lines[:1]  # one heading
    assert {text.split()[1] for text in lines[1:]} == {"left", "tuned", "slow", "other"}
    with Recording(running.recording) as recording:
        changed = [r.detail["value"] for r in recorded_firings(recording, "tuned") if r.kind == "param"]
    assert changed[:2] == [2.5, 3.0]
    assert "no graph runs" in dataflow("top", code=2).stderr


# The board alone


Counts = tuple[int, int, int, int, int, int]


def graph_with(*names: str) -> Graph:
    """A graph of operators with these names, of which a board needs no more."""
    graph = load_text(GRAPH)
    return replace(graph, nodes={name: replace(graph.nodes["left"], name=name) for name in names})


def status(
    process: str,
    *,
    restarts: int = 0,
    ended: bool = False,
    waits: dict[str, dict[tuple[str, str], int]] | None = None,
    behind: dict[str, tuple[float, float]] | None = None,
    **counts: Counts,
) -> ProcessStatus:
    through = frozenset(counts if ended else ())
    return ProcessStatus(process, counts, dict.fromkeys(counts, restarts), through, waits or {}, behind or {})


def test_the_board_follows_operators_from_answer_to_answer() -> None:
    board = Board(graph_with("camera", "detector", "planner"))
    board.update(
        [status("eyes", camera=(10, 10, 0, 0, 10**9, 0)), status("brain", detector=(0, 0, 0, 0, NEVER, 0))], 1.0
    )
    sample = board.update(
        [
            status("eyes", camera=(40, 40, 0, 0, 4 * 10**9, 0)),
            status("brain", detector=(5, 5, 6, 10**9, 2 * 10**9, 15 * 10**8)),
        ],
        3.0,
    )

    camera, detector, planner = sample.rows
    assert (camera.rate, camera.lag, camera.state, camera.process) == (15.0, 0.0, "running", "eyes")
    assert (detector.rate, detector.load, detector.wall, detector.drop_rate) == (2.5, 0.5, 0.75, 3.0)
    assert (detector.lag, detector.state) == (2.0, "dropping")
    assert (planner.state, planner.process, planner.lag) == ("no answer", "", None)


def test_the_board_keeps_the_last_counts_of_a_process_that_is_away_and_takes_up_its_successor() -> None:
    board = Board(graph_with("camera"))
    board.update([status("eyes", camera=(10, 10, 2, 0, 10**9, 0))], 1.0)

    (away,) = board.update([], 2.0).rows
    assert (away.state, away.firings, away.dropped, away.rate) == ("no answer", 10, 2, 0.0)
    (back,) = board.update([status("eyes", restarts=1, camera=(1, 1, 0, 0, 2 * 10**9, 0))], 3.0).rows
    assert (back.state, back.restarts, back.rate) == ("running", 1, 1.0)
    (over,) = board.update([status("eyes", restarts=1, ended=True, camera=(5, 5, 0, 0, 2 * 10**9, 0))], 4.0).rows
    assert over.state == "ended"


def test_timeouts_and_late_messages_are_no_drops() -> None:
    board = Board(graph_with("fusion"))
    board.update([status("brain", fusion=(10, 10, 0, 0, 10**9, 0))], 1.0)
    waits = {"fusion": {("image", "timeout"): 3, ("image", "late"): 2, ("cloud", "late"): 1}}
    sample = board.update([status("brain", fusion=(20, 20, 0, 0, 2 * 10**9, 0), waits=waits)], 2.0)

    (fusion,) = sample.rows
    assert (fusion.state, fusion.dropped, fusion.timeouts, fusion.late) == ("timeout", 0, 3, 3)
    headings = next(text for text in printed(sample, 80) if text.startswith("operator")).split()
    assert headings == ["operator", "process", "state", "Hz", "timeouts", "late", "CPU", "wall", "lag"]


@pytest.mark.parametrize(
    ("read", "sent", "cpu", "told"),
    [
        (15.0, 15.1, 0.9, "reading it takes longer than real time"),
        (
            15.0,
            15.1,
            0.4,
            "reading it computes for 40% of the time that it takes, and for the rest it waits: for a dev",
        ),
        (15.0, 15.1, 0.01, "reading it waits, for a device or a file, and computes next to nothing"),
        (0.1, 15.1, 0.1, "its process is busy with detector"),
    ],
)
def test_a_source_behind_the_clock_is_named_with_who_holds_it_up(
    read: float, sent: float, cpu: float, told: str
) -> None:
    board = Board(graph_with("camera", "detector"))
    board.update([status("all", camera=(10, 10, 0, 0, 10**9, 0), detector=(5, 5, 0, 0, 10**9, 0))], 1.0)
    counts = {"camera": (20, 20, 0, round(cpu * 1e9), 2 * 10**9, 10**9), "detector": (9, 9, 0, 0, 2 * 10**9, 0)}

    sample = board.update([status("all", behind={"camera": (read, sent)}, **counts)], 2.0)

    note = sample.behind["camera"]
    assert note.startswith(f"source 'camera' is 15.1 s behind the clock: {told}")
    camera, detector = sample.rows
    assert (camera.behind_clock, detector.behind_clock) == (15.1, None)
    row = next(text for text in printed(sample, 100) if text.startswith("camera"))
    assert row.split()[-2:] == ["15.1", "s"]


def printed(sample: Sample, width: int) -> list[str]:
    """The lines of a sample on a terminal."""
    console = Console(width=width, file=io.StringIO(), record=True, legacy_windows=False)
    console.print(shown(sample, RunningGraph("robot", "robot", 1, 0.0, (), 0.0, {})))
    return [text.rstrip() for text in console.export_text().splitlines()]


def test_the_table_fits_a_terminal_of_80_columns() -> None:
    names = ["robot", "front_camera/depth_decoder", "trajectory_score", "detector"]
    board = Board(graph_with(*names))
    counts = dict.fromkeys(names, (12345678, 1, 1234567, 10**9, 10**18, 10**9))
    board.update([ProcessStatus("perception_process", counts, dict.fromkeys(names, 12), frozenset())], 1.0)
    more = {name: (12345999, 1, 1239999, 10**10, 10**18 - 10**9 * k, 10**10) for k, name in enumerate(names)}
    sample = board.update([ProcessStatus("perception_process", more, dict.fromkeys(names, 12), frozenset())], 2.0)

    lines = printed(sample, 80)

    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert "…" not in "".join(each[-50:] for each in lines)  # numbers are whole
    assert "1,239,999" in text
    assert "321.0" in text


def test_lines_stand_under_their_heading() -> None:
    board = Board(graph_with("camera", "detector"))
    board.update([status("all", camera=(10, 10, 0, 0, 10**9, 0), detector=(5, 5, 0, 0, 10**9, 0))], 1.0)
    sample = board.update(
        [status("all", camera=(20, 20, 1234, 10**8, 2 * 10**9, 0), detector=(9, 9, 0, 0, 10**9, 0))], 2.0
    )

    top = heading(sample)
    for row in sample.rows:
        text = line(row, sample, 12.0)
        assert text[top.index("state") :].startswith(row.state)
        assert text[: top.index("Hz") + 2].endswith(f"{row.rate:.1f}")
        assert len(text) <= len(top)
