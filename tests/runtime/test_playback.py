"""A replay that is paused and stepped makes what one that is not makes, and is not taken for stuck."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dataflow.client.attach import find_running
from dataflow.client.playback import ReplayControls, ask, steering
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

    @contextmanager
    def controls(supervisor: Supervisor) -> Iterator[None]:
        thread = threading.Thread(target=steer, args=(supervisor,))
        thread.start()
        yield
        thread.join()

    return replay(recorded, placement="one_process", controls=controls, **options)


def until(holds: Any, seconds: float = 30.0) -> None:
    event = threading.Event()
    for _ in range(int(seconds / 0.01)):
        if holds():
            return
        event.wait(0.01)
    raise AssertionError("it does not come true")


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


def test_a_replay_goes_to_a_place_and_on_at_another_rate_but_never_back(recorded: Path) -> None:
    answers: list[dict[str, Any]] = []
    refused: list[str] = []

    def steer(supervisor: Supervisor) -> None:
        with steering(find_running("chaos", wait=30)) as steered:
            first, last = steered.ask(None)["span"]
            middle = first + (last - first) // 2
            steered.ask("to", stamp=middle)
            until(lambda: (answers.append(steered.ask(None)) or answers[-1]["stamp"] or 0) >= middle - 10**8)
            for request in ({"action": "to", "stamp": first}, {"action": "rate", "rate": 0.0}, {"action": "rewind"}):
                with pytest.raises(ValueError, match=r"only forward|expected") as said:
                    steered.ask(**request)
                refused.append(str(said.value))
            answers.append(steered.ask("rate", rate=50.0))
            answers.append(steered.ask("rate", rate=None))
            steered.ask("resume")

    report = stepped(recorded, steer, paused=True)

    assert answers[-3]["paused"]
    assert [answer["rate"] for answer in answers[-2:]] == [50.0, None]
    assert len(refused) == 3
    assert report.streams == replay(recorded, placement="one_process").streams


def test_a_plain_run_is_paused_and_made_to_step_and_makes_the_same(recorded: Path) -> None:
    graph = load_graph(HERE / "chaos.yaml", settings=["count=40"])
    answers: list[dict[str, Any]] = []

    @contextmanager
    def controls(supervisor: Supervisor) -> Iterator[None]:
        def steer() -> None:
            until(lambda: {"left", "right"} <= supervisor.status.operators.keys())
            with steering(find_running("chaos", wait=30)) as steered:
                answers.append(steered.ask("pause"))
                answers.append(steered.ask("step", steps=2))
                until(lambda: supervisor.status.paused)
                steered.ask("rate", rate=None)
                answers.append(steered.ask("resume"))

        thread = threading.Thread(target=steer)
        thread.start()
        yield
        thread.join()

    report = run(graph, placement="process_each", rate=0.02, controls=controls)

    assert [answer["paused"] for answer in answers] == [True, True, False]
    assert answers[0]["span"] is None
    assert report.streams == run(graph, placement="one_process").streams


def test_a_player_moves_a_replay_forward_and_not_back(recorded: Path) -> None:
    seen: list[Any] = []

    def steer(supervisor: Supervisor) -> None:
        with steering(find_running("chaos", wait=30)) as steered:
            controls = ReplayControls(steered)
            middle = (controls.first + controls.last) // 2
            seen.append(controls.request(playing=False, speed=0.5, seek=middle))
            controls.carry_out()
            until(lambda: (steered.ask()["stamp"] or 0) > controls.first)
            seen.append(controls.request(playing=False, speed=0.5, seek=controls.first))
            controls.carry_out()
            seen.append(controls.state() == (False, middle, 0.5))
            steered.ask("rate", rate=None)
            seen.append(controls.look(middle))
            seen.append(controls.state()[2])
            controls.request(playing=True, speed=0.0, seek=None)
            controls.carry_out()

    report = stepped(recorded, steer, paused=True)

    assert seen == [True, False, True, True, 1.0]
    assert report.streams == replay(recorded, placement="one_process").streams


def test_a_script_pauses_and_steps_from_outside(recorded: Path) -> None:
    answers: list[dict[str, Any]] = []

    def steer(supervisor: Supervisor) -> None:
        found = find_running("chaos", wait=30)
        answers.append(ask(found, None))
        answers.append(ask(found, "step", 2))
        until(lambda: (answers.append(ask(found, None)) or answers[-1]["stamp"]) is not None)
        answers.append(ask(found, "resume"))

    report = stepped(recorded, steer, paused=True)

    assert answers[0] | {"span": None} == {
        "ok": True, "paused": True, "ended": False, "stamp": None, "rate": None, "span": None,
    }  # fmt: skip
    first, last = answers[0]["span"]
    assert first < last
    assert answers[1]["paused"]
    assert not answers[-1]["paused"]
    assert report.streams == replay(recorded, placement="one_process").streams
