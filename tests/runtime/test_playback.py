"""A replay or a run that is paused and stepped makes what one that is not makes, and is not taken for stuck."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dataflow.client.attach import NotRunning, find_running
from dataflow.client.playback import ReplayBar, ask, steering
from dataflow.graph import load_graph
from dataflow.supervision.run import replay, run
from dataflow.supervision.supervisor import Supervisor

HERE = Path(__file__).resolve().parent


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("playback") / "run.mcap"
    run(load_graph(HERE / "chaos.yaml", settings=["count=40"]), placement="one_process", record=path)
    return path


def stepped(recorded: Path, steer: Any, **options: Any) -> Any:
    """Replays while `steer(supervisor)` runs on a thread of its own."""
    return replay(recorded, placement="one_process", controls=steered(steer), **options)


def steered(steer: Any) -> Any:
    @contextmanager
    def controls(supervisor: Supervisor) -> Iterator[None]:
        thread = threading.Thread(target=steer, args=(supervisor,))
        thread.start()
        yield
        thread.join()

    return controls


def until(holds: Any, seconds: float = 30.0) -> None:
    event = threading.Event()
    for _ in range(int(seconds / 0.01)):
        if holds():
            return
        event.wait(0.01)
    raise AssertionError("it does not come true")


@pytest.mark.long
def test_pauses_and_steps_change_no_digest_and_outlast_the_timeout(recorded: Path) -> None:
    expected = replay(recorded, placement="one_process").streams
    seen: list[int] = []

    def steer(supervisor: Supervisor) -> None:
        given = lambda: supervisor.status.operators.get("@log")  # noqa: E731
        until(lambda: supervisor.status.paused)
        threading.Event().wait(1.2)  # longer than it may be stuck
        before = given().firings if given() else 0
        supervisor.play("step", 3)
        until(lambda: given() is not None and given().firings == before + 3)
        seen.append(before)
        supervisor.play("resume")

    report = stepped(recorded, steer, paused=True, stall_timeout=0.6)

    assert seen == [0]
    assert report.streams == expected


@pytest.mark.long
def test_a_script_pauses_and_steps_from_outside(recorded: Path) -> None:
    answers: list[dict[str, Any]] = []

    def steer(supervisor: Supervisor) -> None:
        found = find_running("chaos", wait=30)
        answers.append(ask(found, None))
        answers.append(ask(found, "step", 2))
        until(lambda: (answers.append(ask(found, None)) or answers[-1]["stamp"]) is not None)
        answers.append(ask(found, "resume"))

    report = stepped(recorded, steer, paused=True)

    assert answers[0] == {"paused": True, "ended": False, "speed": None, "stamp": None} | {
        "replay": {"span": [10**9, 10**9 + 39 * 8_000_000 + 39 * 7919 % 2_000_001], "first": 10**9}
    }
    assert answers[1]["paused"]
    assert not answers[-1]["paused"]
    assert report.streams == replay(recorded, placement="one_process").streams


@pytest.mark.long
def test_a_playback_bar_moves_a_replay_through_a_graph(recorded: Path) -> None:
    told: list[Any] = []

    def steer(supervisor: Supervisor) -> None:
        until(lambda: supervisor.status.paused)
        with steering(find_running("chaos", wait=30)) as steered:
            bar = ReplayBar(steered, steered.ask(None))
            told.append(bar.state())
            bar.request(playing=False, speed=8.0, seek=None)
            supervisor.play("step", 2)  # as keys do
            until(lambda: (bar.refresh(), bar.state()[1] > bar.span[0])[1])
            told.append(bar.state())
            told.append(bar.request(playing=True, speed=1000.0, seek=bar.span[0]))
            told.append(bar.state()[0])

    report = stepped(recorded, steer, paused=True)

    first = 10**9
    assert told[0] == (False, first, 1.0)
    assert (told[1][0], told[1][2]) == (False, 8.0)
    assert told[2].endswith("--start 0.000")
    assert told[3] is True
    assert report.streams == replay(recorded, placement="one_process").streams


@pytest.mark.long
def test_run_with_sources_in_two_processes_is_paused_stepped_and_paced(recorded: Path) -> None:
    graph = load_graph(HERE / "chaos.yaml", settings=["count=40"])
    answers: list[dict[str, Any]] = []
    given: list[dict[str, int]] = []

    def steer(supervisor: Supervisor) -> None:
        firings = lambda: {  # noqa: E731
            name: supervisor.status.operators[name].firings if name in supervisor.status.operators else 0
            for name in ("left", "right")
        }
        until(lambda: supervisor.status.paused)
        found = find_running("chaos", wait=30)
        given.append(firings())
        answers.append(ask(found, "step", 3))
        until(lambda: firings() == {"left": 3, "right": 3})
        threading.Event().wait(1.2)  # longer than it may be stuck
        given.append(firings())
        answers.append(ask(found, "speed", speed=50.0))
        until(lambda: supervisor.status.speed == 50.0)
        supervisor.play("slower")
        until(lambda: supervisor.status.speed == 25.0)
        answers.append(ask(found, "resume"))

    report = run(graph, placement="process_each", paused=True, controls=steered(steer), stall_timeout=0.6)

    assert given == [{"left": 0, "right": 0}, {"left": 3, "right": 3}]
    assert answers[0] | {"stamp": None} == {
        "paused": True, "ended": False, "speed": None, "stamp": None, "replay": None,
    }  # fmt: skip
    assert answers[-1]["speed"] == 25.0
    assert not answers[-1]["paused"]
    assert report.streams == replay(recorded, placement="one_process").streams


def test_pausing_a_live_run_is_refused_with_the_reason() -> None:
    graph = load_graph(HERE / "chaos.yaml", settings=["count=400"], live=True)
    told: list[str] = []

    def steer(supervisor: Supervisor) -> None:
        found = find_running("chaos", wait=30)
        with pytest.raises(NotRunning) as refused:
            ask(found, "pause", timeout=30.0)
        told.append(str(refused.value))
        supervisor.play("pause")  # is not heard
        supervisor.stop()

    report = run(graph, placement="one_process", live=True, controls=steered(steer))

    assert "it is a live run: devices and the clock do not wait" in told[0]
    assert report.interrupted
