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

from dataflow.cli.top import Board, _table, _title
from dataflow.client.attach import find_running
from dataflow.client.processes import HostStatus
from dataflow.graph import load_graph
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.report import RunReport
from dataflow.supervision.supervisor import Supervisor
from dataflow.sync import NEVER

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
    """A live run on a thread of its own, in a host each, until it is told to stop."""

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


def rows_of(outcome: Any) -> dict[str, dict[str, Any]]:
    return {row["operator"]: row for row in json.loads(outcome.stdout)["operators"]}


@pytest.mark.usefixtures("running")
def test_top_tells_rates_drops_load_and_hosts(dataflow) -> None:
    rows = rows_of(dataflow("top", "--json"))

    assert list(rows) == ["left", "tuned", "slow", "other"]
    assert rows["tuned"]["state"] == rows["left"]["state"] == "running"
    assert 20 < rows["left"]["rate"] < 150  # 100 Hz, where the machine can
    assert rows["slow"]["state"] == "dropping"
    assert rows["slow"]["load"] > 0.5
    assert rows["slow"]["drop_rate"] > 5
    assert rows["tuned"]["restarts"] == 0
    assert rows["other"]["host"] == "far"
    assert 0 <= rows["tuned"]["lag"] < 1


@pytest.mark.usefixtures("running")
def test_top_prints_a_table(dataflow) -> None:
    told = dataflow("top", "--once", "--every", "0.3").stdout

    assert told.startswith("tunable  running for ")
    assert [line.split()[0] for line in told.splitlines()[1:]] == ["operator", "left", "tuned", "slow", "other"]
    assert "expected seconds, 0.05 or more" in dataflow("top", "--every", "0", code=2).stderr


def test_a_host_that_does_not_answer_is_shown_as_such_and_a_change_waits_for_it(dataflow, running: Background) -> None:
    """The last test of the file but one: the host is stopped for a moment."""
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
    with Recording(running.recording) as recording:
        changed = [r.detail["value"] for r in recorded_firings(recording, "tuned") if r.kind == "param"]
    assert changed[:2] == [2.5, 3.0]
    assert "no graph runs" in dataflow("top", code=2).stderr


# The board alone


def status(
    host: str, *, restarts: int = 0, ended: bool = False, **counts: tuple[int, int, int, int, int]
) -> HostStatus:
    return HostStatus(host, counts, dict.fromkeys(counts, restarts), frozenset(counts if ended else ()))


def test_the_board_follows_operators_from_answer_to_answer() -> None:
    board = Board(["camera", "detector", "planner"])
    board.update([status("eyes", camera=(10, 10, 0, 0, 10**9)), status("brain", detector=(0, 0, 0, 0, NEVER))], 1.0)
    rows = board.update(
        [status("eyes", camera=(40, 40, 0, 0, 4 * 10**9)), status("brain", detector=(5, 5, 6, 10**9, 2 * 10**9))], 3.0
    )

    camera, detector, planner = rows
    assert (camera.rate, camera.lag, camera.state, camera.host) == (15.0, 0.0, "running", "eyes")
    assert (detector.rate, detector.load, detector.drop_rate) == (2.5, 0.5, 3.0)
    assert (detector.lag, detector.state) == (2.0, "dropping")
    assert (planner.state, planner.host, planner.lag) == ("no answer", "", None)


def test_the_board_keeps_the_last_counts_of_a_host_that_is_away_and_takes_up_its_successor() -> None:
    board = Board(["camera"])
    board.update([status("eyes", camera=(10, 10, 2, 0, 10**9))], 1.0)

    (away,) = board.update([], 2.0)
    assert (away.state, away.firings, away.dropped, away.rate) == ("no answer", 10, 2, 0.0)
    (back,) = board.update([status("eyes", restarts=1, camera=(1, 1, 0, 0, 2 * 10**9))], 3.0)
    assert (back.state, back.restarts, back.rate) == ("running", 1, 1.0)
    (over,) = board.update([status("eyes", restarts=1, ended=True, camera=(5, 5, 0, 0, 2 * 10**9))], 4.0)
    assert over.state == "ended"


def test_the_table_fits_a_terminal_of_80_columns() -> None:
    from rich.console import Console

    names = ["robot", "front_camera/depth_decoder", "trajectory_score", "detector"]
    board = Board(names)
    counts = dict.fromkeys(names, (12345678, 1, 1234567, 10**9, 10**18))
    board.update([HostStatus("perception_host", counts, dict.fromkeys(names, 12), frozenset())], 1.0)
    more = {name: (12345999, 1, 1239999, 10**10, 10**18 - 10**9 * k) for k, name in enumerate(names)}
    rows = board.update([HostStatus("perception_host", more, dict.fromkeys(names, 12), frozenset())], 2.0)
    console = Console(width=80, record=True, file=open("/dev/null", "w"), legacy_windows=False)  # noqa: SIM115

    console.print(_table(rows, _title("robot", time.time() - 100)))

    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert "…" not in "".join(line[-50:] for line in lines)  # numbers are whole
    assert "1,239,999" in text
    assert "5432.0" in text
