"""A live run goes on without its recorder: the disk is full, or the recorder dies."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tests_runtime_graphs import chain

from dataflow.graph import Graph
from dataflow.recording import Recording
from dataflow.recording.parts import Storage
from dataflow.supervision.core.report import RunFailed, RunReport
from dataflow.supervision.run import run
from dataflow.supervision.supervisor import Supervisor
from dataflow.verification.verify import verify

SECOND = 1_000_000_000


def robot(count: int, padding: int = 0) -> Graph:
    return chain(
        "first: {use: runtime_operators:Tuned, inputs: {x: left/fast}}",
        f"big: {{use: runtime_operators:Counter, params: {{count: {count}, period: 20000000, padding: {padding}}}}}",
    )


def ran(graph: Graph, act: Any = lambda supervisor: None, **options: Any) -> RunReport:
    """Runs it live, while `act` is done on another thread."""

    @contextmanager
    def acting(supervisor: Supervisor) -> Iterator[None]:
        thread = threading.Thread(target=act, args=(supervisor,))
        thread.start()
        yield
        thread.join(30)

    return run(graph, live=True, placement="process_each", controls=acting, **options)


def await_time(supervisor: Supervisor, stamp: int) -> None:
    """Waits until a source has come so far."""
    while supervisor.status.phase != "over" and supervisor.status.operators["big"].done < stamp:
        time.sleep(0.02)


def kill_recorder(supervisor: Supervisor) -> None:
    await_time(supervisor, 3 * SECOND)
    os.kill(supervisor.pid_of("@recorder"), signal.SIGKILL)


@pytest.mark.long
def test_killed_recorder_is_replaced_and_the_run_continues(tmp_path: Path) -> None:
    report = ran(robot(250), kill_recorder, record=tmp_path / "run.mcap")

    assert report.operators["big"].firings == 250
    assert any("'@recorder' was killed by SIGKILL; started again" in note for note in report.notes)
    facts = report.files["@recorder"]
    assert facts["deaths"] == 1
    assert facts["path"] == str(tmp_path / "run_001.mcap")
    with Recording(tmp_path / "run.mcap") as before, Recording(tmp_path / "run_001.mcap") as after:
        stamps = [[m.stamp for m in part.messages(["test/big/fast"])] for part in (before, after)]
        assert not after.torn
    assert stamps[0][-1] < stamps[1][0] < stamps[0][-1] + 4 * SECOND
    assert stamps[1][-1] == SECOND + 249 * 20_000_000
    assert not [v for v in verify(tmp_path / "run_001.mcap", jobs=1).operators if v.verdict == "culprit"]


@pytest.mark.long
def test_a_recorder_that_is_killed_ends_a_run_that_is_to_end(tmp_path: Path) -> None:
    with pytest.raises(RunFailed, match="'@recorder' was killed by SIGKILL"):
        ran(robot(250), kill_recorder, record=tmp_path / "run.mcap", storage=Storage(on_failure="end"))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)]
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount command")
    if done.returncode != 0:
        pytest.skip(f"a file system cannot be mounted here: {done.stderr.decode().strip()}")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


@pytest.mark.long
def test_a_full_disk_stops_the_recording_until_it_has_room_and_never_the_run(small_disk: Path) -> None:
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(2_600_000))

    def make_room(supervisor: Supervisor) -> None:
        await_time(supervisor, 4 * SECOND)
        ballast.unlink()

    report = ran(robot(400, padding=5000), make_room, record=small_disk / "run.mcap", compression="none")

    assert report.operators["big"].firings == 400
    facts = report.files["@recorder"]
    parts = [small_disk / "run.mcap", small_disk / "run_001.mcap"]
    assert facts["parts"][:2] == [str(part) for part in parts]
    assert "No space left" in facts["lost"]["reasons"][0]
    stored = 0
    for part in map(Path, facts["parts"]):
        with Recording(part) as recording:
            stored += recording.streams["test/big/fast"].count
    assert stored + facts["lost"]["streams"]["test/big/fast"] == 400
