"""What goes wrong ends the run in bounded time, names the first cause, and leaves nothing behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
from tests_runtime_graphs import chain

from dataflow.graph import Graph
from dataflow.recording import Recording
from dataflow.records.reading import recorded_firings
from dataflow.supervision.core.report import RunFailed
from dataflow.supervision.plan import RunPlan
from dataflow.supervision.supervisor import Supervisor

HERE = Path(__file__).resolve().parent


def broken(how: str) -> Graph:
    return chain(
        f"bad: {{use: runtime_operators:Broken, params: {{how: {how}}}, inputs: {{x: left/fast}}}}",
        "sum: {use: runtime_operators:Sum, inputs: {x: bad/y}}",
    )


def fails(graph: Graph, **options: object) -> RunFailed:
    with pytest.raises(RunFailed) as caught:
        Supervisor(RunPlan(graph, **options)).run()
    return caught.value


@pytest.mark.parametrize("placement", ["one_process", pytest.param("process_each", marks=pytest.mark.long)])
def test_an_operator_that_raises_is_named_with_its_traceback(placement: str) -> None:
    failure = fails(broken("raise"), placement=placement)

    assert failure.operator == "bad"
    assert "operator 'bad' failed in fire at stamp 1200000000: RuntimeError: the gripper is on fire" in str(failure)
    assert "runtime_operators.py" in failure.details


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("stamp", "bad.y emitted stamp 1199999999; it must lie at or after the firing's 1200000000"),
        pytest.param("type", "Broken returned a str; return a message, a mapping or None", marks=pytest.mark.long),
        ("mutate", "bad changed the memory of its input 'x' (FeatureVector at stamp 1200000000)"),
    ],
)
def test_a_broken_contract_is_named(how: str, words: str) -> None:
    failure = fails(broken(how), placement="one_process", paranoid=True)

    assert failure.operator == "bad"
    assert words in str(failure)


def test_an_operator_that_exits_is_named_as_one_that_raises() -> None:
    failure = fails(broken("exit"), placement="process_each")

    assert failure.operator == "bad"
    assert "in fire at stamp 1200000000: SystemExit: enough" in str(failure)


def test_children_of_operators_end_with_their_process() -> None:
    lines: list[str] = []

    Supervisor(RunPlan(broken("children")), on_output=lambda label, line: lines.append(line)).run()

    left = int(next(line for line in lines if "left behind" in line).rpartition(" ")[2])
    deadline = time.monotonic() + 5.0
    while psutil.pid_exists(left) and psutil.Process(left).status() != psutil.STATUS_ZOMBIE:
        assert time.monotonic() < deadline, "a child of an operator outlived the run"
        time.sleep(0.02)


@pytest.mark.long
def test_a_daemon_that_an_operator_leaves_is_named_and_ends_with_its_process() -> None:
    lines: list[str] = []

    report = Supervisor(RunPlan(broken("daemon")), on_output=lambda label, line: lines.append(line)).run()

    left = int(next(line for line in lines if "left behind" in line).rpartition(" ")[2])
    (note,) = report.notes
    who, _, what = note.partition(" left processes behind, which were killed: ")
    assert "'bad'" in who.removeprefix("process ").split(" or ")  # processes that end at the same moment are named, too
    assert what.endswith(f"(process {left})")
    assert not psutil.pid_exists(left)


def test_a_source_that_is_stopped_runs_its_finally(tmp_path: Path) -> None:
    note = tmp_path / "note"
    graph = chain(f"tidy: {{use: runtime_operators:Tidy, params: {{note: {note}}}}}")
    supervisor = Supervisor(RunPlan(graph, placement="process_each"))

    def stop() -> None:
        while supervisor.status.phase == "starting":
            time.sleep(0.02)
        time.sleep(0.2)
        supervisor.stop()

    threading.Thread(target=stop, daemon=True).start()

    assert supervisor.run().interrupted
    assert note.read_text() == "device released"


def test_a_process_that_dies_is_named_with_the_signal_and_how_far_it_was() -> None:
    failure = fails(broken("die"), placement="process_each")

    assert "process 'bad' was killed by SIGKILL while running" in str(failure)


@pytest.mark.long
def test_killed_nursery_fails_the_run_and_leaves_no_process(tmp_path: Path) -> None:
    graph = chain(
        "bad: {use: runtime_operators:Broken, params: {how: children}, inputs: {x: left/fast}}",
        "sum: {use: runtime_operators:Sum, inputs: {x: bad/y}}",
    )
    lines: list[str] = []
    supervisor = Supervisor(
        RunPlan(graph, placement="process_each", rate=0.05, record=tmp_path / "run.mcap"),
        on_output=lambda label, line: lines.append(line),
    )
    pids: list[int] = []

    def kill() -> None:
        while not any("left behind" in line for line in lines):
            time.sleep(0.02)
        pids.extend(supervisor.pid_of(label) for label in ("left", "bad", "sum", "@recorder"))
        os.kill(psutil.Process(pids[0]).ppid(), signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()
    with pytest.raises(RunFailed, match="the process that starts the others was killed by SIGKILL"):
        supervisor.run()

    started = int(next(line for line in lines if "left behind" in line).rpartition(" ")[2])
    assert len(pids) == 4
    assert not [pid for pid in pids if psutil.pid_exists(pid)]
    assert not psutil.pid_exists(started) or psutil.Process(started).status() == psutil.STATUS_ZOMBIE
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.streams["test/left/fast"].count > 0


@pytest.mark.long
def test_an_operator_that_hangs_ends_the_run_within_the_stall_timeout() -> None:
    failure = fails(broken("hang"), placement="process_each", stall_timeout=1.0)

    assert "no progress for 1 s; still busy: process 'bad'" in str(failure)
    assert re.search(r'runtime_operators.py", line \d+ in process', failure.details), failure.details


def test_a_fault_in_native_code_ends_the_run_with_the_line_that_called_it() -> None:
    failure = fails(broken("crash"), placement="process_each")

    assert "process 'bad' was killed by SIGSEGV" in str(failure)
    assert re.search(r'runtime_operators.py", line \d+ in process', failure.details), failure.details


def test_failure_leaves_a_recording_with_its_outcome(tmp_path: Path) -> None:
    path = tmp_path / "failed.mcap"

    fails(broken("raise"), record=path, placement="process_each")

    with Recording(path) as recording:
        assert recording.metadata["dataflow:outcome"]["outcome"].startswith("failed: operator 'bad'")
        assert recording.streams["test/left/fast"].count > 0
        assert not recording.torn
        last = list(recorded_firings(recording, "bad"))[-1]
        assert (last.outcome, last.stamp) == ("error", 1_200_000_000)
        assert last.detail["error"] == "RuntimeError: the gripper is on fire"


def unexplained(path: Path) -> dict[str, int]:
    """By stream, the messages of a recording that no firing record of their operator accounts for."""
    found = {}
    with Recording(path) as recording:
        for stream in (s for s, facts in recording.streams.items() if facts.count and "/@/" not in s):
            _, operator, _ = stream.split("/")
            made = {
                (record.incarnation, out.seq, out.stamp)
                for record in recorded_firings(recording, operator)
                for out in record.outputs
                if out is not None
            }
            messages = {(m.incarnation, m.seq, m.message.stamp) for m in recording.messages([stream])}
            assert messages
            found[stream] = len(messages - made)
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("live", "how"),
    [
        (False, "raise"),
        (True, "raise"),
        (True, "die"),  # the supervisor holds what its process had not sent
    ],
)
def test_after_a_failure_every_recorded_message_is_explained(live: bool, how: str, tmp_path: Path) -> None:
    path = tmp_path / "failed.mcap"
    graph = chain(
        f"bad: {{use: runtime_operators:Broken, params: {{how: {how}}}, inputs: {{x: left/fast}}}}",
        "smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}}",
        "merge: {use: runtime_operators:Merge, inputs: {all: [smooth/mean, left/slow]}}",
        count=1000,
    )

    with pytest.raises(RunFailed):
        Supervisor(RunPlan(graph, record=path, placement="process_each", live=live)).run()

    lost = unexplained(path)
    assert {"test/left/fast", "test/bad/y"} <= set(lost)  # the others may not have got as far as a message
    assert not any(lost.values()), lost


@pytest.mark.long
def test_output_of_operators_reaches_the_user() -> None:
    said: list[tuple[str, str]] = []

    Supervisor(RunPlan(broken("chatter")), on_output=lambda label, line: said.append((label, line))).run()

    assert ("bad", "still here") in said


class Running:
    """`dataflow run` or the like in a process of its own."""

    def __init__(self, *arguments: str, cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dataflow.cli.main", *arguments],
            cwd=cwd,
            env={
                **os.environ,
                "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent.parent)]),
                "XDG_RUNTIME_DIR": str(cwd),
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.folder = cwd
        self.family: list[psutil.Process] = []

    def until_running(self, processes: int) -> None:
        """Waits until all processes exist and the sink has had its first message."""
        deadline = time.monotonic() + 30
        me = psutil.Process(self.process.pid)
        while time.monotonic() < deadline:
            self.family = me.children(recursive=True)
            if len(self.family) >= processes + 1 and (self.folder / "seen").exists():
                return
            time.sleep(0.05)
        raise AssertionError(f"no message within 30 s; processes: {self.family}")

    def end(self, timeout: float = 30) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=timeout)
        return self.process.returncode, out, err

    def survivors(self, within: float = 20.0) -> list[psutil.Process]:
        _, alive = psutil.wait_procs(self.family, timeout=within)
        return [p for p in alive if p.status() != psutil.STATUS_ZOMBIE]


GRAPH = """
graph: long
namespace: test
operators:
  left: {use: runtime_operators:Counter, params: {count: 1000000}}
  smooth: {use: runtime_operators:Smooth, inputs: {x: left/fast}, params: {sleep: 0.002}}
  sum: {use: runtime_operators:Sum, inputs: {x: smooth/mean}, params: {seen: seen}}
"""


@pytest.fixture
def long_run(tmp_path: Path) -> Running:
    (tmp_path / "long.yaml").write_text(GRAPH)
    running = Running("run", "long.yaml", "--record", "run.mcap", "-q", cwd=tmp_path)
    running.until_running(processes=4)
    return running


@pytest.mark.long
def test_ctrl_c_drains_and_completes_the_recording(long_run: Running, tmp_path: Path) -> None:
    long_run.process.send_signal(signal.SIGINT)
    code, out, err = long_run.end()

    assert code == 130, err
    assert "interrupted" in out
    assert not long_run.survivors()
    with Recording(tmp_path / "run.mcap") as recording:
        assert not recording.torn
        assert recording.metadata["dataflow:outcome"]["outcome"] == "interrupted"
        counts = {s: i.count for s, i in recording.streams.items()}
        assert counts["test/left/fast"] > 0


@pytest.mark.long
def test_killing_the_supervisor_leaves_no_process_and_a_readable_recording(long_run: Running, tmp_path: Path) -> None:
    long_run.process.kill()
    long_run.end()

    assert not long_run.survivors()
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.streams["test/left/fast"].count > 0


@pytest.mark.parametrize("victim", [pytest.param("recorder", marks=pytest.mark.long), "operator"])
def test_killing_a_process_ends_the_run_and_names_it(long_run: Running, tmp_path: Path, victim: str) -> None:
    time.sleep(1.2)
    recorder = [p for p in long_run.family if any(f.path.endswith("run.mcap") for f in p.open_files())]
    others = [p for p in long_run.family if p.children() == [] and p not in recorder]
    (recorder if victim == "recorder" else others)[0].kill()
    code, _, err = long_run.end()

    assert code == 1
    assert "was killed by SIGKILL" in err
    assert not long_run.survivors()
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.torn == (victim == "recorder")
        assert recording.streams["test/left/fast"].count > 0


def test_nothing_is_left_in_shared_memory(tmp_path: Path) -> None:
    before = set(os.listdir("/dev/shm")) if Path("/dev/shm").is_dir() else set()

    Supervisor(
        RunPlan(chain("sum: {use: runtime_operators:Sum, inputs: {x: left/fast}}"), placement="process_each")
    ).run()

    assert {n for n in (os.listdir("/dev/shm") if before else []) if "dataflow" in n or "zenoh" in n} <= before
    assert threading.active_count() < 20
