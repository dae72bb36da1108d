"""A replay that is paused and stepped makes what one that is not makes, and is not taken for stuck."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from dataflow.client.attach import find_running
from dataflow.client.playback import ask
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


def test_a_script_pauses_and_steps_from_outside(recorded: Path) -> None:
    answers: list[dict[str, Any]] = []

    def steer(supervisor: Supervisor) -> None:
        found = find_running("chaos", wait=30)
        answers.append(ask(found, None))
        answers.append(ask(found, "step", 2))
        until(lambda: (answers.append(ask(found, None)) or answers[-1]["stamp"]) is not None)
        answers.append(ask(found, "resume"))

    report = stepped(recorded, steer, paused=True)

    assert answers[0] == {"ok": True, "paused": True, "ended": False, "stamp": None}
    assert answers[1]["paused"]
    assert not answers[-1]["paused"]
    assert report.streams == replay(recorded, placement="one_process").streams
