"""`run`, `replay` and `verify`: results, files, refusals, failures, Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dataflow.cli.main import app
from dataflow.recording import Recording

PACKAGE = Path(__file__).resolve().parents[2]

ZSTD = b"\x28\xb5\x2f\xfd"
"""What a compressed chunk begins with."""


def test_a_run_reports_operators_and_figures_on_stdout_and_progress_on_stderr(dataflow, small: Path) -> None:
    told = dataflow("run", small, "--one-process", "--set", "count=10", "-v")

    assert "small  complete" in told.stdout
    assert any(line.split()[:3] == ["left", "10", "13"] for line in told.stdout.splitlines())  # firings, out
    assert "10 of 10 steps" in told.stderr
    assert "steps" not in told.stdout


def test_the_json_report_stands_alone_on_stdout(recorded) -> None:
    path, report = recorded

    assert report["complete"] is True
    assert report["operators"]["left"]["firings"] == 30
    assert report["summaries"]["sum"]["count"] > 0
    assert set(report["streams"]["test/left/fast"]) == {"messages", "digest"}
    assert report["files"]["@recorder"]["path"] == str(path)


@pytest.mark.long
def test_a_replay_makes_the_same_digests_and_diff_agrees(dataflow, recorded, tmp_path: Path) -> None:
    path, report = recorded
    again = tmp_path / "again.mcap"

    replayed = json.loads(dataflow("replay", path, "--record", again, "--one-process", "--json", "-q").stdout)

    assert replayed["streams"] == report["streams"]
    assert "the same: 5 streams, bit for bit" in dataflow("diff", path, again).stdout


ACTING = """\
graph: acting
namespace: test
operators:
  left: {use: "runtime_operators:Counter", params: {count: 30}}
  smooth: {use: "runtime_operators:Smooth", inputs: {x: left/fast}}
  act: {use: "runtime_operators:Act", inputs: {x: smooth/mean}, params: {seen: "%s"}}
"""


@pytest.mark.long
@pytest.mark.parametrize("placement", ["--one-process", "--process-each"])
def test_a_replay_that_leaves_out_an_external_sink_is_recorded_and_verified(
    dataflow, tmp_path: Path, placement: str
) -> None:
    graph, path, again = (tmp_path / name for name in ("acting.yaml", "run.mcap", "again.mcap"))
    graph.write_text(ACTING % (tmp_path / "acted"))
    dataflow("run", graph, "--record", path, "--one-process", "-q")
    (tmp_path / "acted").unlink()

    dataflow("replay", path, "--record", again, placement, "-q")

    assert not (tmp_path / "acted").exists()
    assert "the same" in dataflow("diff", path, again).stdout
    dataflow("verify", again, "-q")


@pytest.mark.long
def test_a_replay_of_a_part_takes_only_that_part(dataflow, recorded) -> None:
    path, _ = recorded

    replayed = json.loads(
        dataflow("replay", path, "--start", 0.1, "--end", 0.195, "--one-process", "--json", "-q").stdout
    )

    assert replayed["streams"]["test/left/fast"]["messages"] == 10  # stamps 0.10, 0.11 ... 0.19 s


def test_unchanged_recording_verifies_as_identical(dataflow, recorded) -> None:
    path, _ = recorded

    told = dataflow("verify", path, "--jobs", "1", "--json", "-q")

    assert json.loads(told.stdout)["identical"] is True


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (b"faults:\n  - {kind: stop, operator: lefd, for: 1s, at: 1s}", "plan.yaml:2:28: no operator 'lefd'"),
        (
            b"faults:\n  - {kind: param, operator: smooth, name: sleep, values: [1], at: 1s}",
            "'sleep' of 'smooth' cannot",
        ),
        (b"\xff\xfe\x00", "plan.yaml: 'utf-8' codec"),
    ],
)
def test_a_faulty_fault_plan_is_refused_before_anything_runs(
    dataflow, small: Path, tmp_path: Path, plan: bytes, message: str
) -> None:
    path = tmp_path / "plan.yaml"
    path.write_bytes(plan)

    told = dataflow("run", small, "--chaos", path, code=2)

    assert message in told.stderr
    assert "internal error" not in told.stderr
    assert told.stdout == ""


def test_a_replay_onto_itself_is_refused_under_any_name(dataflow, recorded, tmp_path: Path) -> None:
    path, _ = recorded
    link = tmp_path / "link.mcap"
    link.symlink_to(path)
    before = path.read_bytes()

    for name in (path, link):
        told = dataflow("replay", path, "--record", name, "--overwrite", code=2)
        assert "is the recording that is being replayed" in told.stderr
    assert path.read_bytes() == before


def test_files_that_are_no_recordings_are_refused_with_the_reason(dataflow, small: Path, data_dir: Path) -> None:
    for command in ("replay", "verify", "info"):
        assert "not an MCAP file" in dataflow(command, small, code=2).stderr
        assert "expected a recording" in dataflow(command, small.parent / "x.mcap", code=2).stderr
    foreign = data_dir / "bags" / "nav2_turtlebot.mcap"
    assert "does not hold the graph" in dataflow("replay", foreign, code=2).stderr


@pytest.fixture(scope="module")
def damaged(recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with one wrong byte in a compressed chunk of messages; the first chunk holds firing records."""
    data = bytearray(recorded[0].read_bytes())
    data[data.index(ZSTD, data.index(ZSTD) + 1) + 100] ^= 0xFF
    path = tmp_path_factory.mktemp("damaged") / "damaged.mcap"
    path.write_bytes(data)
    return path


@pytest.mark.long
@pytest.mark.parametrize("asked", ["0", "1"])
def test_damaged_recording_is_one_line_and_the_traceback_optional(
    damaged: Path, monkeypatch: pytest.MonkeyPatch, asked: str
) -> None:
    monkeypatch.setenv("DATAFLOW_TRACEBACK", asked)

    told = CliRunner().invoke(app, ["replay", str(damaged), "--one-process", "-q"])

    assert told.exit_code == 1
    assert "damaged.mcap is damaged: chunk" in told.stderr
    assert "`dataflow recover` may save what is left" in told.stderr
    assert ("Traceback" in told.stderr) == (asked == "1")
    assert asked == "1" or told.stderr.splitlines()[1:] == ["where in the code: run it again with DATAFLOW_TRACEBACK=1"]


def test_failing_operator_ends_the_run_with_traceback_and_recording(dataflow, small: Path, tmp_path: Path) -> None:
    path = tmp_path / "failed.mcap"

    told = dataflow("run", small, "--set", "at=20", "--one-process", "--record", path, code=1)

    assert "operator 'gripper' failed" in told.stderr
    assert "the gripper is on fire" in told.stderr
    assert "runtime_operators.py" in told.stderr  # the operator's own traceback
    assert f"{path} (" in told.stderr
    assert "failed" in dataflow("info", path).stdout


def started(*words: object, folder: Path | None = None) -> subprocess.Popen[str]:
    """A command in a process, in `folder`."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PACKAGE), str(PACKAGE / "tests" / "runtime")])}
    command = [sys.executable, "-m", "dataflow.cli.main", *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=folder, env=env, text=True, **pipes)


def test_ctrl_c_ends_a_run_in_order_with_code_130(small: Path, tmp_path: Path) -> None:
    path = tmp_path / "interrupted.mcap"
    settings = ("--set", "count=100000", "--set", "sleep=0.02", "--one-process")
    running = started("run", small, *settings, "--record", path)
    try:
        assert running.stderr is not None
        assert any(line.startswith("running") for line in running.stderr)
        running.send_signal(signal.SIGINT)
        stdout, _ = running.communicate(timeout=30)
    finally:
        running.kill()

    assert running.returncode == 130
    assert "small  interrupted" in stdout
    assert f"wrote   {path}" in stdout


ABSENT = """\
from dataflow.messages import FeatureVector
from dataflow.operator import Out, Param, Source, SourceError


class Reader(Source):
    made: Out[FeatureVector]
    path: str = Param(doc="folder")
    layout: str = Param("any", doc="how files lie in any folder")

    def setup(self):
        raise SourceError(f"no any.png in {self.path}/images, as any such folder has")

    def stream(self):
        yield from ()
"""


def test_missing_data_is_one_line_with_the_parameter_to_set(dataflow, tmp_path: Path) -> None:
    (tmp_path / "absent_reader.py").write_text(ABSENT)
    (tmp_path / "absent.yaml").write_text(
        f"graph: absent\noperators:\n  camera: {{use: 'absent_reader:Reader', params: {{path: {tmp_path}/nowhere}}}}\n"
    )
    told = dataflow("run", tmp_path / "absent.yaml", "--path", tmp_path, "-q", code=1).stderr

    assert told.splitlines() == [
        "error: operator 'camera' failed in setup(): SourceError: no any.png in "
        f"{tmp_path}/nowhere/images, as any such folder has",
        "name another with --set camera.path=...",
    ]


SLOW = """\
import time
from pathlib import Path

from dataflow.messages import FeatureVector
from dataflow.operator import In, Operator


class Slow(Operator):
    x: In[FeatureVector]

    def setup(self):
        Path("begun").touch()
        time.sleep(100)

    def process(self, x):
        pass
"""


@pytest.mark.long
def test_ctrl_c_while_the_graph_starts_is_a_stop_and_no_failure(tmp_path: Path) -> None:
    (tmp_path / "slow_setup.py").write_text(SLOW)
    (tmp_path / "slow.yaml").write_text(
        "graph: slow\noperators:\n  left: {use: 'runtime_operators:Counter'}\n"
        "  last: {use: 'slow_setup:Slow', inputs: {x: left/fast}}\n"
    )
    running = started("run", "slow.yaml", "--record", "run.mcap", folder=tmp_path)
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / "begun").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        stdout, stderr = running.communicate(timeout=60)
    finally:
        running.kill()

    assert running.returncode == 130
    assert "slow  interrupted while starting" in stdout
    assert "still starting, and killed: process 'last'" in stdout
    assert "wrote   run.mcap (0 messages" in stdout
    assert "error" not in stderr
    assert "fail" not in stdout + stderr
    with Recording(tmp_path / "run.mcap") as recording:
        assert not recording.torn
        assert recording.metadata["dataflow:outcome"]["outcome"] == "interrupted"


@pytest.mark.long
def test_saved_view_is_opened_where_there_is_a_display(dataflow, small: Path, tmp_path: Path, monkeypatch) -> None:
    saved, noted = tmp_path / "run.rrd", tmp_path / "opened"
    viewer = tmp_path / "rerun"
    viewer.write_text(f'#!/bin/sh\nfor last; do :; done\necho "$last" > {noted}.new && mv {noted}.new {noted}\n')
    viewer.chmod(viewer.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("RERUN_CLI_PATH", str(viewer))
    words = ["run", small, "--set", "count=5", "--one-process", "--view", saved, "--open"]

    unopened = dataflow(*words).stderr
    assert "is not opened: there is no display" in unopened
    assert f"rerun {saved}" in unopened
    assert not noted.exists()
    assert "replace it with --overwrite" in dataflow(*words, code=2).stderr
    monkeypatch.setenv("DISPLAY", ":7")
    told = dataflow(*words, "--overwrite")

    assert "opening" in told.stderr
    assert f"wrote   {saved}" in told.stdout
    for _ in range(100):
        if noted.exists():
            break
        os.sched_yield()
        signal.sigtimedwait([], 0.05)
    assert noted.read_text().strip() == str(saved)


@pytest.mark.long
def test_a_viewer_that_fails_does_not_end_the_run(dataflow, small: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("RERUN_CLI_PATH", str(tmp_path / "absent"))

    told = dataflow("run", small, "--view", "serve", "--one-process", "--rate", 1, "--set", "count=150")

    assert "viewer: error: the Rerun program is missing" in told.stderr
    assert "small  complete" in told.stdout
