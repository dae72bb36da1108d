"""What `dataflow top` makes of the answers of processes."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from rich.console import Console

from dataflow.cli.commands.following.health import silent
from dataflow.cli.support.status_table import Sample, StatusTable, heading, line, machine_line, shown
from dataflow.client.processes import MachineStatus, ProcessStatus
from dataflow.graph import load_text
from dataflow.graph.model import Graph
from dataflow.sync import NEVER
from dataflow.transport.registry import RunningGraph

GRAPH = """\
graph: robot
operators:
  left: {use: runtime_operators:Counter}
"""
CHAIN = """\
graph: robot
operators:
  camera: {use: runtime_operators:Counter}
  detector: {use: runtime_operators:Sum, inputs: {x: camera/fast}}
"""

Counts = tuple[int, int, int, int, int, int]


def graph_with(*names: str) -> Graph:
    """A graph of operators with these names, of which a table needs no more."""
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


def test_status_table_follows_operators_between_answers() -> None:
    table = StatusTable(graph_with("camera", "detector", "planner"))
    table.update(
        [status("eyes", camera=(10, 10, 0, 0, 10**9, 0)), status("brain", detector=(0, 0, 0, 0, NEVER, 0))], 1.0
    )
    sample = table.update(
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


def test_status_table_keeps_counts_of_a_silent_process() -> None:
    table = StatusTable(graph_with("camera"))
    table.update([status("eyes", camera=(10, 10, 2, 0, 10**9, 0))], 1.0)

    (away,) = table.update([], 2.0).rows
    assert (away.state, away.firings, away.dropped, away.rate) == ("no answer", 10, 2, 0.0)
    (back,) = table.update([status("eyes", restarts=1, camera=(1, 1, 0, 0, 2 * 10**9, 0))], 3.0).rows
    assert (back.state, back.restarts, back.rate) == ("running", 1, 1.0)
    (over,) = table.update([status("eyes", restarts=1, ended=True, camera=(5, 5, 0, 0, 2 * 10**9, 0))], 4.0).rows
    assert over.state == "ended"


def test_timeouts_and_late_messages_are_no_drops() -> None:
    table = StatusTable(graph_with("fusion"))
    table.update([status("brain", fusion=(10, 10, 0, 0, 10**9, 0))], 1.0)
    waits = {"fusion": {("image", "timeout"): 3, ("image", "late"): 2, ("cloud", "late"): 1}}
    sample = table.update([status("brain", fusion=(20, 20, 0, 0, 2 * 10**9, 0), waits=waits)], 2.0)

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
def test_source_behind_the_clock_is_named_with_the_cause(read: float, sent: float, cpu: float, told: str) -> None:
    table = StatusTable(graph_with("camera", "detector"))
    table.update([status("all", camera=(10, 10, 0, 0, 10**9, 0), detector=(5, 5, 0, 0, 10**9, 0))], 1.0)
    counts = {"camera": (20, 20, 0, round(cpu * 1e9), 2 * 10**9, 10**9), "detector": (9, 9, 0, 0, 2 * 10**9, 0)}

    sample = table.update([status("all", behind={"camera": (read, sent)}, **counts)], 2.0)

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
    table = StatusTable(graph_with(*names))
    counts = dict.fromkeys(names, (12345678, 1, 1234567, 10**9, 10**18, 10**9))
    table.update([ProcessStatus("perception_process", counts, dict.fromkeys(names, 12), frozenset())], 1.0)
    more = {name: (12345999, 1, 1239999, 10**10, 10**18 - 10**9 * k, 10**10) for k, name in enumerate(names)}
    sample = table.update([ProcessStatus("perception_process", more, dict.fromkeys(names, 12), frozenset())], 2.0)

    lines = printed(sample, 80)

    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert "…" not in "".join(each[-50:] for each in lines)  # numbers are whole
    assert "1,239,999" in text
    assert "321.0" in text


def test_lines_stand_under_their_heading() -> None:
    table = StatusTable(graph_with("camera", "detector"))
    table.update([status("all", camera=(10, 10, 0, 0, 10**9, 0), detector=(5, 5, 0, 0, 10**9, 0))], 1.0)
    sample = table.update(
        [status("all", camera=(20, 20, 1234, 10**8, 2 * 10**9, 0), detector=(9, 9, 0, 0, 10**9, 0))], 2.0
    )

    top = heading(sample)
    for row in sample.rows:
        text = line(row, sample, 12.0)
        assert text[top.index("state") :].startswith(row.state)
        assert text[: top.index("Hz") + 2].endswith(f"{row.rate:.1f}")
        assert len(text) <= len(top)


def test_findings_of_operators_are_among_the_notes() -> None:
    table = StatusTable(graph_with("camera", "check"))
    found = {"check": "edges of colour and depth did not fit"}
    counts = dict.fromkeys(("camera", "check"), (1, 1, 0, 0, 10**9, 0))
    sample = table.update([ProcessStatus("eyes", counts, dict.fromkeys(counts, 0), frozenset(), found=found)], 1.0)
    assert "check: edges of colour and depth did not fit" in "\n".join(printed(sample, 80))


@pytest.mark.parametrize(
    ("silences", "named"),
    [
        ({"camera": 0.1, "detector": 0.1}, []),
        ({"camera": 0.1, "detector": 14.0}, ["detector: has not fired for 14.0 s; before, every 0.20 s"]),
        ({"camera": 14.0, "detector": 14.0}, ["camera: has not fired for 14.0 s; before, every 0.10 s"]),
        ({"camera": 1.9, "detector": 0.9}, []),
    ],
)
def test_an_operator_that_hangs_and_a_source_that_is_silent_are_named(
    silences: dict[str, float], named: list[str]
) -> None:
    counts = {"camera": [1000, 0, 0, 0, NEVER, 0], "detector": [500, 0, 0, 0, NEVER, 0]}
    status = ProcessStatus("eyes", counts, dict.fromkeys(counts, 0), frozenset(), silences=silences)

    graph = load_text(CHAIN)
    assert list(silent(graph, [status], running=100.0, over=2.0)) == named


@pytest.mark.parametrize(("seconds", "named"), [(5.0, []), (14.0, ["detector: has been at its first call for 14.0 s"])])
def test_an_operator_that_hangs_in_its_first_call_is_named(seconds: float, named: list[str]) -> None:
    counts = {"camera": [1000, 0, 0, 0, NEVER, 0]}
    silences = {"camera": 0.1, "detector": seconds}
    status = ProcessStatus("eyes", counts, dict.fromkeys(counts, 0), frozenset(), silences=silences)

    assert list(silent(load_text(CHAIN), [status], running=100.0, over=2.0)) == named


def test_unmeasured_clock_of_another_machine_has_no_figure() -> None:
    assert machine_line("robot", MachineStatus(False, 0, 0, 0)) == "machine robot: link down, clock not measured yet"
    assert machine_line("robot", MachineStatus(True, 1_250_000, 600_000, 2)) == (
        "machine robot: link up, clock +1.250 ms ± 0.300 ms, 2 messages dropped"
    )
